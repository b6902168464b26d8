"""Sets of packed scenes: a scene is unpacked when it is asked for, and kept as long as there is room."""

from collections import OrderedDict
from collections.abc import Sequence

import numpy as np
import torch
from tensordict import TensorDict
from torch import Tensor

from e2rl.scene.packed import unpack
from e2rl.scene.scene import RAGGED, Rows

Layout = dict[str, tuple[str, tuple[int, ...]]]  # of the arrays of a scene: type and shape


class PackedRows(Rows):
    """Scenes in records, of which the `room` that were used last are kept unpacked.

    records, digests: of all scenes of a file, and their `content_hash`; layout: types and, of ragged keys, the largest
    shape, to which all are padded; picked [S]: which records are this set's scenes (None: all).
    """

    def __init__(
        self,
        records: Sequence[bytes | memoryview],
        layout: Layout,
        digests: Sequence[str],
        room: int,
        picked: Sequence[int] | None = None,
    ) -> None:
        self.records, self.layout, self.digests = records, layout, digests
        self.picked = range(len(digests)) if picked is None else picked
        self._make_room(room)

    def __reduce__(self) -> tuple:
        """Without what is kept: another machine gets the records of this set alone."""
        records, digests = [bytes(self.records[each]) for each in self.picked], self.hashes()
        return PackedRows, (records, self.layout, digests, self.room)

    def __len__(self) -> int:
        return len(self.picked)

    def shape(self, key: str) -> tuple[int, ...]:
        return self.layout[key][1]

    def hashes(self) -> list[str]:
        return [self.digests[each] for each in self.picked]

    def chosen(self, index: Sequence[int]) -> "PackedRows":
        picked = [self.picked[each] for each in index]
        return PackedRows(self.records, self.layout, self.digests, self.room_wanted, picked)

    def whole(self) -> TensorDict:
        """All scenes, which are all kept from now on."""
        if self.room < len(self):
            self._make_room(len(self))
        return self.resident(torch.arange(len(self)))[0]

    def resident(self, index: Tensor) -> tuple[TensorDict, Tensor]:
        wanted = index.unique()
        if len(wanted) > self.room:
            apart = self._empty(len(wanted))
            for place, scene in enumerate(wanted.tolist()):
                self._write(apart, place, scene, self._unpacked(scene))
            return apart, torch.searchsorted(wanted, index)
        for scene in wanted.tolist():
            if scene in self._places:
                self._places.move_to_end(scene)
        for scene in wanted.tolist():
            if scene not in self._places:
                content = self._unpacked(scene)
                self._write(self._kept, self._place(scene), scene, content)
        return self._kept, torch.tensor([self._places[scene] for scene in index.tolist()], dtype=torch.int64)

    def _unpacked(self, scene: int) -> dict[str, np.ndarray]:
        return unpack(self.records[self.picked[scene]])

    def _make_room(self, room: int) -> None:
        self.room_wanted, self.room = room, min(room, len(self))
        self._kept, self._places = self._empty(self.room), OrderedDict[int, int]()  # scene -> row, the last used last

    def _place(self, scene: int) -> int:
        """A row for a scene that is not kept: its own where there is room for all, else a free one, or that of the
        scene that was not used for longest."""
        if self.room == len(self):
            place = scene
        elif len(self._places) < self.room:
            place = len(self._places)
        else:
            place = self._places.popitem(last=False)[1]
        self._places[scene] = place
        return place

    def _empty(self, count: int) -> TensorDict:
        """Rows that take up memory only when they are written."""
        rows = {key: torch.from_numpy(np.empty((count, *shape), dtype)) for key, (dtype, shape) in self.layout.items()}
        return TensorDict(rows | {"scene_index": torch.empty(count, dtype=torch.int64)}, batch_size=[count])

    def _write(self, rows: TensorDict, place: int, scene: int, content: dict[str, np.ndarray]) -> None:
        rows["scene_index"][place] = scene
        for key, value in content.items():
            row = rows[key][place].numpy()
            if value.shape != row.shape:
                row.fill(RAGGED.get(key, 0))
            row[tuple(map(slice, value.shape))] = value
