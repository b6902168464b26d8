#!/usr/bin/env bash
# In a replay buffer on TorchRL's LazyMemmapStorage every item has the name of the first one.
#
# A tensordict holds strings beside its tensors (NonTensorData), such as the scene that an item is of. LazyTensorStorage,
# ListStorage and LazyStackStorage give each item its own string back. LazyMemmapStorage, which is for buffers that are larger
# than the memory, gives the right tensors and the string of the first item for all of them, whether they were added one by
# one, in batches or at once, and without a warning. A metric per scene then has one scene, and a filter by name lets
# everything through or nothing. Keep the number of the scene in a tensor. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 torchrl==0.14.1 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import torch
from tensordict import NonTensorStack, TensorDict
from torchrl.data import LazyMemmapStorage, LazyStackStorage, LazyTensorStorage, ListStorage, ReplayBuffer

NAMES = ["merge", "roundabout", "crossing", "cut-in"]


def one_by_one(buffer):
    for number, name in enumerate(NAMES):
        buffer.add(TensorDict(number=torch.tensor(number), scene=name))


def in_batches(buffer):
    for start in (0, 2):
        names = NonTensorStack(*NAMES[start : start + 2])
        buffer.extend(TensorDict(number=torch.arange(start, start + 2), scene=names, batch_size=[2]))


def at_once(buffer):
    buffer.extend(TensorDict(number=torch.arange(4), scene=NonTensorStack(*NAMES), batch_size=[4]))


print("torchrl", version("torchrl"), "tensordict", version("tensordict"))
lost = []
for kind in (ListStorage, LazyStackStorage, LazyTensorStorage, LazyMemmapStorage):
    for fill in (one_by_one, in_batches, at_once):
        buffer = ReplayBuffer(storage=kind(len(NAMES)))
        fill(buffer)
        items = [buffer[index] for index in range(len(NAMES))]
        numbers, scenes = [item["number"].item() for item in items], [item["scene"] for item in items]
        print(f"{kind.__name__}, {fill.__name__}: {list(zip(numbers, scenes))}")
        assert numbers == [0, 1, 2, 3]
        if scenes != NAMES:
            assert scenes == NAMES[:1] * 4
            lost.append((kind, fill))
sys.exit(0 if lost == [(LazyMemmapStorage, fill) for fill in (one_by_one, in_batches, at_once)] else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py" 2> "$folder/log" | grep -v INFO || { cat "$folder/log"; exit 1; }
