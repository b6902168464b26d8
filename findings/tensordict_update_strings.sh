#!/usr/bin/env bash
# tensordict's update_ and copy_ write the tensors of another scene, and leave the name of the scene that was there.
#
# update_ is documented to update a tensordict in place with the values of another one or of a dict. It does so for tensors.
# A string or another value that is no tensor (NonTensorData, a str field of a tensorclass) keeps its old value, with no
# warning. update_(scene="new") returns as if it had been written. update, update(inplace=True), set_ and update_at_ of the
# same package write the string. A buffer that is filled in place step by step then holds the numbers of one scene under
# the name of another. Exits 0 as long as that is so.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install -q torch==2.13.0 tensordict==0.14.3 numpy==2.4.6
cat > "$folder/program.py" <<'PYTHON'
import sys
from importlib.metadata import version

import torch
from tensordict import NonTensorStack, TensorDict, tensorclass


@tensorclass
class Item:
    speed: torch.Tensor
    scene: str


def single(speed, scene):
    return TensorDict(speed=torch.tensor(speed), scene=scene)


def batch(speed, scene):
    return TensorDict(speed=torch.full((2,), speed), scene=NonTensorStack(scene + " 1", scene + " 2"), batch_size=[2])


def item(speed, scene):
    return Item(speed=torch.tensor(speed), scene=scene, batch_size=[])


def content(data):
    if isinstance(data, Item):
        return data.speed.tolist(), data.scene
    scene = data.get("scene")
    return data["speed"].tolist(), scene.tolist() if isinstance(scene, NonTensorStack) else data["scene"]


WAYS = {
    "update(other)": lambda data, other: data.update(other),
    "update(other, inplace=True)": lambda data, other: data.update(other, inplace=True),
    "update_(other)": lambda data, other: data.update_(other),
    "copy_(other)": lambda data, other: data.copy_(other),
}
print("tensordict", version("tensordict"), "torch", torch.__version__)
stale = {}
for way, write in WAYS.items():
    for make in (single, batch, item):
        data, old, new = make(0.0, "merge"), make(0.0, "merge"), make(8.0, "crossing")
        write(data, new)
        speed, scene = content(data)
        print(f"{way} of a {make.__name__}: speed {speed}, scene {scene}")
        assert speed == content(new)[0] and scene in (content(old)[1], content(new)[1])
        stale[way, make.__name__] = scene == content(old)[1]
words = single(0.0, "merge").update_(speed=torch.tensor(8.0), scene="crossing")
print(f"update_(speed=8, scene='crossing') of a single: speed {words['speed'].item()}, scene {words['scene']}")
alone = single(0.0, "merge").set_("scene", "crossing")
print(f"set_('scene', 'crossing') of a single: scene {alone['scene']}")
expected = all(value == way.startswith(("update_(", "copy_(")) for (way, _), value in stale.items())
sys.exit(0 if expected and words["scene"] == "merge" and alone["scene"] == "crossing" else 1)
PYTHON
"$folder/venv/bin/python" "$folder/program.py"
