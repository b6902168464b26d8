"""`python benchmarks/puffer_core.py SDIST [REPEATS]`: agent-steps per CPU second of
PufferLib's drive core in C, as rows like those of `peers.py`.

SDIST: pufferlib-3.0.0.tar.gz as PyPI has it, which cannot be installed without GitHub.
Its core is compiled without the drawing; its one map is driven, each agent accelerating
at random, with what its own step does.
"""

import json
import shutil
import subprocess
import sys
import tarfile
import tempfile
from pathlib import Path

NAME = "pufferlib-3.0.0.tar.gz"
FOLDER = "pufferlib-3.0.0/pufferlib/"
CORE = FOLDER + "ocean/gpudrive/gpudrive.h"
MAP = FOLDER + "resources/gpudrive/map_942.bin"
DRAWING = ("raylib.h", "raymath.h", "rlgl.h")  # that the core includes
FLAGS = ("-O3", "-march=native", "-ffast-math", "-w")
HEADER = "#include <stdbool.h>\n#undef PI\n#define PI 3.14159265358979323846f\n"
BATCHES = (1, 32)
STEPS = 2_000  # of a batch, divided by its size
WORK = "bicycle of all, collisions, road edges, observation of all"
PROGRAM = """
#include "core.h"
int main(int count, char** arguments) {
    int size = atoi(arguments[2]), steps = atoi(arguments[3]), agents = 0;
    GPUDrive* all = calloc(size, sizeof(GPUDrive));
    for (int k = 0; k < size; k++) {
        all[k].map_name = arguments[1];
        all[k].spawn_immunity_timer = 50;
        allocate(&all[k]);
        c_reset(&all[k]);
        agents += all[k].active_agent_count;
    }
    clock_t begin = clock();
    for (int step = 0; step < steps; step++)
        for (int k = 0; k < size; k++) {
            for (int agent = 0; agent < all[k].active_agent_count; agent++) {
                all[k].actions[2 * agent] = rand() % 7;
                all[k].actions[2 * agent + 1] = rand() % 13;
            }
            c_step(&all[k]);
        }
    double seconds = (double)(clock() - begin) / CLOCKS_PER_SEC;
    printf("%d %f\\n", agents / size, agents * (double)steps / seconds);
}
"""


def main(sdist: str, repeats: int = 5) -> None:
    """Compile and drive, and print the rows."""
    if shutil.which("gcc") is None:
        sys.exit("gcc: not found; install it")
    try:
        with tarfile.open(sdist) as archive:
            core = content(archive, CORE).decode().partition("const Color ")[0]
            driven = content(archive, MAP)
    except (OSError, tarfile.TarError, KeyError) as error:
        sys.exit(
            f"{sdist}: not {NAME} ({str(error).splitlines()[0]}); download it from PyPI"
        )
    rows = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "core.h").write_text(core)
        (folder / "map.bin").write_bytes(driven)
        (folder / "drive.c").write_text(PROGRAM)
        for header in DRAWING:
            (folder / header).write_text(HEADER)
        subprocess.run(
            ["gcc", *FLAGS, "-I.", "drive.c", "-lm", "-o", "drive"],
            cwd=folder,
            check=True,
        )
        for batch in BATCHES:
            command = ["./drive", "map.bin", str(batch), str(STEPS // batch)]
            runs = [
                subprocess.run(
                    command, cwd=folder, check=True, capture_output=True, text=True
                )
                for _ in range(repeats)
            ]
            measured = [run.stdout.split() for run in runs]
            agents = int(measured[0][0])
            rows.append([batch, agents, WORK, max(float(rate) for _, rate in measured)])
    print(json.dumps({"version": "3.0.0", "rows": rows}))


def content(archive: tarfile.TarFile, name: str) -> bytes:
    """Returns a file of the archive."""
    file = archive.extractfile(name)
    assert file is not None, name
    return file.read()


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:3]))
