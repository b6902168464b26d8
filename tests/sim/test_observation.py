"""Observations: the same under a rigid motion of the scene and in any order of the
others; blind to padding."""

import pytest
import torch

import e2rl
from e2rl.scenes.recording import LIGHT_GREEN, LIGHT_RED
from e2rl.scenes.scene import SceneSet
from e2rl.sim.env import DrivingEnv
from e2rl.sim.mission import mission_of
from e2rl.sim.observation import (
    PROBE_Y,
    light_features,
    observation_config,
    observation_layout,
)
from e2rl.sim.prospects import OFFSETS
from e2rl.sim.settings import SimSettings
from e2rl.sim.static import static_scene
from tests.synthetic import make_scenes

# Quantities that change sign in a mirror.
SIDED = (
    "yaw_rate",
    "offset",
    "heading_sin",
    "curvature",
    "y",
    "velocity_y",
    "turn_rate",
)


def mirrored(observation):
    """The observations [..., D] of the mirrored scenes, y to -y; twice gives the
    original."""
    names = [entry.name for entry in observation_layout()]
    source = torch.arange(len(names))
    # Blocks whose last axis runs from right to left.
    for start, end, width in (
        ("border.", "", len(PROBE_Y)),
        ("manoeuvre.", ".gap", len(OFFSETS)),
        ("manoeuvre.", ".contact", len(OFFSETS)),
    ):
        block = torch.tensor(
            [
                index
                for index, name in enumerate(names)
                if name.startswith(start) and name.endswith(end)
            ]
        )
        source[block] = block.view(-1, width).flip(1).flatten()
    sided = [name.rsplit(".", 1)[1] in SIDED for name in names]
    sign = torch.where(torch.tensor(sided), -1.0, 1.0)
    return observation[..., source] * sign


def scenes_with_everything():
    return make_scenes(
        2,
        num_vehicles=9,
        num_vrus=3,
        red_light_x=70.0,
    )


def observe(scenes: SceneSet):
    env = DrivingEnv(scenes, SimSettings(), len(scenes))
    td = env.reset()
    index = torch.arange(len(scenes))[:, None]
    env.reset(td.select("scene_index").set("scene_index", index))
    action = torch.tensor([0.5, 0.05]).repeat(len(scenes), 1)
    for _ in range(10):
        td = env.step(td.empty().set("action", action))["next"]
    return td["observation"]


def quarter_turn(scenes: SceneSet, shift: torch.Tensor):
    """Rotate the scene by +90 degrees about the origin, then shift it."""
    s = scenes.scenes

    def turn(xy):
        return torch.stack([-xy[..., 1], xy[..., 0]], -1) + shift

    for key in ("start", "logged"):
        s[key] = torch.cat(
            [turn(s[key][..., :2]), s[key][..., 2:3] + torch.pi / 2, s[key][..., 3:]],
            -1,
        )
    for key in ("route_points", "light_points", "lane_points", "drivable_points"):
        s[key] = turn(s[key])
    last = s["field"].shape[-1] - 1
    origin = s["field_origin"]
    s["field"] = s["field"].transpose(1, 2).flip(1).contiguous()
    s["field_origin"] = torch.stack([-(origin[:, 1] + last), origin[:, 0]], -1) + shift
    return scenes


def test_rigid_motion_changes_nothing():
    moved = observe(quarter_turn(scenes_with_everything(), torch.tensor([40.0, -25.0])))
    assert torch.allclose(observe(scenes_with_everything()), moved, atol=2e-3)


def test_order_of_the_others_changes_nothing():
    scenes = scenes_with_everything()
    rows = torch.cat(
        [
            torch.tensor([0]),
            1 + torch.randperm(31, generator=torch.Generator().manual_seed(0)),
            torch.arange(32, 48),
        ]
    )
    for key in (
        "start",
        "start_accel",
        "start_yaw_rate",
        "valid",
        "size",
        "agent_type",
        "parked",
    ):
        scenes.scenes[key] = scenes.scenes[key][:, rows]
    for key in ("logged", "logged_valid"):
        scenes.scenes[key] = scenes.scenes[key][:, :, rows]
    assert torch.allclose(observe(scenes), observe(scenes_with_everything()), atol=1e-5)


def test_absent_agents_leave_no_trace():
    scenes = scenes_with_everything()
    for key in ("start", "logged"):
        absent = ~scenes.scenes["valid" if key == "start" else "logged_valid"]
        scenes.scenes[key] = torch.where(absent[..., None], 1e3, scenes.scenes[key])
    assert torch.equal(observe(scenes), observe(scenes_with_everything()))


@pytest.mark.parametrize(
    ("speed", "limit"), [(8.0, 12.0), (15.0, 15.5)]
)  # m/s; the ego accelerates by half
def test_a_map_without_limits_looks_like_one_with_the_usual_one_or_that_of_the_ego_s_speed(
    speed, limit
):
    unknown, certain = (
        observe(
            make_scenes(
                2,
                speed=speed,
                limit=value,
            )
        )
        for value in (0.0, limit)
    )
    assert torch.allclose(unknown, certain, atol=1e-6)
    assert not torch.allclose(
        certain,
        observe(
            make_scenes(
                2,
                speed=speed,
                limit=limit + 1.0,
            )
        ),
        atol=1e-3,
    )


def test_beyond_the_recording_a_light_keeps_its_last_state_in_its_own_scene():
    scene = scenes_with_everything().scenes
    scene["light_state"][0], scene["light_state"][1] = LIGHT_RED, LIGHT_GREEN
    static = static_scene(scene, mission_of(scene))
    last = scene["light_state"].shape[1] - 1
    here = torch.full((2,), 20.0)
    at_the_end, beyond = (
        light_features(
            observation_config(torch.device("cpu")),
            static,
            step=torch.full((2,), step),
            s=here,
        )
        for step in (last, last + 40)
    )
    assert torch.equal(beyond, at_the_end)
    assert beyond[0, 0] == 1
    assert beyond[1, 2] == 1


def observations(scenes, actions):
    """[B, T, D] of a drive by actions [T, 2] in every scene."""
    env = DrivingEnv(scenes, SimSettings(), len(scenes))
    observed = []
    td = env.reset()
    for action in actions:
        observed.append(td["observation"])
        td = env.step(td.set("action", action.expand(len(scenes), 2)))["next"].exclude(
            "reward"
        )
    return torch.stack(observed, 1)


def test_driving_in_the_mirror_looks_like_the_mirror_of_driving():
    """Roads, lights, curves and traffic of the bundled scenes; the ego steers and
    accelerates at random."""
    torch.manual_seed(0)
    scenes = e2rl.load_scenes(
        "bundled",
        num_scenes=6,
        versions=["recorded", "mirrored"],
    )
    first = [
        k
        for k, name in enumerate(scenes.scene_id)
        if f"{name}~mirrored" in scenes.scene_id
    ]
    other = [scenes.scene_id.index(f"{scenes.scene_id[k]}~mirrored") for k in first]
    actions = torch.randn(20, 2) * torch.tensor([1.5, 0.15])
    observed = observations(scenes.chosen(first), actions)
    reflected = observations(scenes.chosen(other), actions * torch.tensor([1.0, -1.0]))
    assert torch.allclose(mirrored(observed), reflected, atol=2e-3)
    assert not torch.allclose(observed, reflected, atol=0.1), (
        "and these scenes are not symmetric themselves"
    )
    assert torch.equal(mirrored(mirrored(observed)), observed)
