"""Readers of recorded logs, and of the scenes made of them."""

import io
import os
import pickle
import random
import shutil
import zipfile
from typing import Any

import numpy as np
import torch

from e2rl.run.errors import InputError
from e2rl.scenes.scenarionet import ScenarioNetSource, safe_load
from e2rl.scenes.scene_cache import unpack
from tools.fuzz.corpus import SMALL
from tools.fuzz.damage import Calls, damaged, hostile_pickle, mutated, with_other_number
from tools.fuzz.garbage import MOST, require, require_plain, require_plausible, require_same_scenes
from tools.fuzz.inputs import Inputs

MEMBER = pickle.dumps({"id": "one", "tracks": {"a": {"state": {"position": np.arange(600.0).reshape(-1, 3)}}}})


class Logs(Inputs):
    def pickle_bytes(self, draw: random.Random) -> None:
        """Damaged bytes of scenario pickles."""
        require_plain(safe_load(damaged(draw.choice(self.corpus.pickles), draw), "input"), 40 * MOST)

    def pickle_programs(self, draw: random.Random) -> None:
        """Pickles that run code, claim much, nest deep, forge arrays, or are random opcodes."""
        require_plain(safe_load(hostile_pickle(draw, self.mark), "input"), MOST)

    def descriptions(self, draw: random.Random) -> None:
        """Scenario descriptions with parts removed or replaced, up to the scene."""
        content = pickle.dumps(mutated(draw.choice(self.corpus.descriptions), draw), draw.choice([2, 4]))
        self.file("logs/input.pkl", content)
        self.scenes(ScenarioNetSource(str(self.folder / "logs"), build=SMALL, workers=1, skip_invalid=True))

    def archives(self, draw: random.Random) -> None:
        """Damaged zips, bombs, odd members, and folders with pipes and links."""
        if draw.random() < 0.1:
            return self.folders(draw)
        buffer = io.BytesIO()
        method = draw.choice([zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
        with zipfile.ZipFile(buffer, "w", method) as archive:
            name = draw.choice(
                ["a/one.pkl", "../../one.pkl", "/etc/one.pkl", "a\\..\\one.pkl", "x" * 300 + ".pkl", ".pkl"]
            )
            bomb = draw.random() < 0.1
            archive.writestr(name, b"\0" * (1 << 26) if bomb else MEMBER)
            if draw.random() < 0.3:
                archive.writestr("b/two.pkl", pickle.dumps(Calls(draw, self.mark)))
        content = buffer.getvalue()
        path = self.file("input.zip", content if draw.random() < 0.2 else damaged(content, draw))
        source = ScenarioNetSource(str(path))
        for log in source.logs():
            require(len(source.content(log)) <= MOST, "more than a log may have")
            require_plain(safe_load(source.content(log), log), MOST)
        return None

    def folders(self, draw: random.Random) -> None:
        path = self.folder / "folder" / "input.pkl"
        shutil.rmtree(path.parent, ignore_errors=True)
        path.parent.mkdir()
        make = [
            lambda: os.mkfifo(path),
            lambda: path.symlink_to(self.folder / "nothing"),
            lambda: path.symlink_to(path),
            lambda: path.symlink_to("/dev/zero"),
            lambda: path.mkdir(),
            lambda: os.truncate(self.file("folder/input.pkl", b""), 1 << 36),
        ]
        draw.choice(make)()
        source = ScenarioNetSource(str(path.parent))
        source.fingerprint() if draw.random() < 0.5 and not path.is_file() else None
        for log in source.logs():
            safe_load(source.content(log), log)

    def indexes(self, draw: random.Random) -> None:
        """index.csv beside the logs: names of places."""
        lines = ["file,location_group", *(f"input{k}.pkl,place {k}" for k in range(9))]
        self.file("places/logs/a.pkl", b"")
        self.file("places/index.csv", damaged("\n".join(lines).encode(), draw))
        found = ScenarioNetSource(str(self.folder / "places" / "logs")).locations
        require(all(isinstance(part, str) for pair in found.items() for part in pair), "a place that is no text")

    def commonroad(self, draw: random.Random) -> None:
        """CommonRoad XML: damaged, with entities, or nested deep."""
        from e2rl.scenes.commonroad import CommonRoadSource

        content = draw.choice(self.corpus.commonroad)
        kind = draw.random()
        if kind < 0.1:
            entity = b'<!DOCTYPE a [<!ENTITY x "y"><!ENTITY z SYSTEM "file:///etc/passwd">]>'
            content = content.replace(b"<commonRoad", entity + b"<commonRoad", 1)
        elif kind < 0.2:
            content = content.replace(b"</commonRoad>", b"<a>" * 100_000 + b"</commonRoad>")
        elif kind < 0.6:
            content = with_other_number(content, draw)
        else:
            content = damaged(content, draw)
        self.file("xml/input.xml", content)
        self.scenes(CommonRoadSource(str(self.folder / "xml"), build=SMALL, workers=1, skip_invalid=True))

    def argoverse2(self, draw: random.Random) -> None:
        """Argoverse 2 scenarios: damaged tables and maps."""
        from e2rl.scenes.argoverse2 import Argoverse2Source

        folder = self.folder / "av2"
        for path in self.corpus.argoverse2:
            content = path.read_bytes()
            if path.suffix == ".json" and draw.random() < 0.5:
                content = with_other_number(content, draw)
            elif draw.random() < 0.6:
                content = damaged(content, draw)
            self.file(f"av2/{path.name}", content)
        self.scenes(Argoverse2Source(str(folder), build=SMALL, workers=1, skip_invalid=True))

    def scenes(self, source: Any) -> None:
        """Read and build the scenes of a source, and look at them."""
        (log,) = source.logs()
        rows = source._rows_of(log)
        for row in rows:
            if row.scene is not None:
                require_plausible({key: torch.from_numpy(value) for key, value in unpack(row.scene.record).items()})
        if all(row.scene is None for row in rows):
            raise InputError(rows[0].reason)

    def scene_caches(self, draw: random.Random) -> None:
        """Files of the scene cache: what is not what was written is built anew."""
        from e2rl.scenes.scene_cache import read

        found = read(self.file("scenes.packed", damaged(self.corpus.cache, draw)), room=4)
        if found is None:
            raise InputError("built anew")
        require_same_scenes(found, self.corpus.scenes)
