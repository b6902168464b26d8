"""Write the bundled scenes: python tools/generate_scenes.py [--seed 0] [--nets 80]
[--out e2rl/assets/scenes].

Needs the build-time extra: pip install -e '.[scenegen]'. The same seed and SUMO version
give the same files.
"""

import argparse
import hashlib
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from scenegen.archive import Place, pack  # noqa: E402
from scenegen.families import schedule  # noqa: E402
from scenegen.simulate import DT, RECORDED, convert, densify, run  # noqa: E402
from scenegen.tracks import park, stack_tracks  # noqa: E402
from scenegen.windows import cut_windows  # noqa: E402

from e2rl.scenes.bundled import SPLITS

PATTERN = (
    "train",
    "train",
    "tune",
    "train",
    "test",
)  # of every five nets: 60 / 20 / 20 per cent


def make_net(index: int, family, seed: int, most: int, folder: Path):
    """Simulate one net; returns its map, its scenes and why windows were refused."""
    rng = np.random.default_rng([seed, index])
    layout = family(rng, f"{family.__name__}_{index:03d}")
    path, net = convert(layout, folder)
    tracks, lights = run(
        layout, path, net, folder, int(rng.integers(1, 2**31 - 1)), rng
    )
    states, valid, size = stack_tracks(tracks, round(RECORDED / DT), rng)
    densify(net.lanes)
    parking = park(net, states, valid, size, rng)
    scene_map = Place(
        layout.name,
        net.lanes,
        net.drivable + parking.strips,
        lights,
        parking.pose,
        parking.size,
    )
    scenes, refused = cut_windows(scene_map, states, valid, size, net.border, most, rng)
    return scene_map, scenes, refused


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--nets", type=int, default=80)
    parser.add_argument(
        "--windows", type=int, default=3, help="at most this many scenes of a net"
    )
    parser.add_argument("--out", type=Path, default=Path("e2rl/assets/scenes"))
    options = parser.parse_args()
    began = time.time()
    nets = []
    refusals = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for index, family in enumerate(schedule(options.nets)):
            scene_map, scenes, refused = make_net(
                index, family, options.seed, options.windows, Path(folder)
            )
            refusals += refused
            print(
                f"{scene_map.name}: {len(scenes)} scenes, refused {dict(refused)}",
                flush=True,
            )
            if scenes:
                nets.append((family.__name__, scene_map, scenes))
    nets.sort(
        key=lambda row: row[0]
    )  # stable: families one after another, so that all splits get their share of each
    made = {split: ([], []) for split in SPLITS}
    for turn, (_, scene_map, scenes) in enumerate(nets):
        maps, kept = made[PATTERN[turn % len(PATTERN)]]
        maps.append(scene_map)
        kept.extend(scenes)
    options.out.mkdir(parents=True, exist_ok=True)
    for split, (maps, scenes) in made.items():
        path = options.out / f"{split}.npz"
        np.savez_compressed(path, **pack(maps, scenes))
        content = path.read_bytes()
        print(
            f"{split}: {len(maps)} nets, {len(scenes)} scenes, {len(content) / 1e6:.2f} MB"
        )
        print(
            f'    "{split}": "{hashlib.sha256(content).hexdigest()}",  # SHA256 of '
            "e2rl/scenes/bundled.py"
        )
    print(f"refused {dict(refusals)}; {time.time() - began:.0f} s")


if __name__ == "__main__":
    main()
