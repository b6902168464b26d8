"""Rollouts and their files: exact keys and types, readable without pickle, whole or
refused, the same when read."""

import io
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from e2rl.metrics.score import score_rollouts
from e2rl.run.errors import InputError
from e2rl.scenes.recording import VEHICLE
from e2rl.sim.rollout_file import Failure, Rollout
from e2rl.sim.rollouts import Rollouts, polylines
from tests.metrics.random_rollouts import random_rollouts
from tests.synthetic import make_scenes

DTYPES = {
    "format": "U", "scene_id": "U", "location": "U", "dataset": "U", "split": "U", "method": "U", "ego_policy": "U",
    "seed": "i", "eta": "f", "dt": "f", "ego": "i", "states": "f4", "valid": "b", "size": "f4", "agent_type": "U",
    "simulated": "b", "adversaries": "b", "logged": "f4", "logged_valid": "b", "lane_points": "f", "lane_offsets": "i",
    "lane_width": "f", "drivable_points": "f", "drivable_offsets": "i",
}  # fmt: skip


@pytest.fixture(scope="module")
def rollouts():
    return random_rollouts(4, seed=1)


def test_files_have_the_format_s_keys_types_and_names(tmp_path, rollouts):
    paths = rollouts.to_npz(tmp_path)
    assert [path.name for path in paths][:2] == [
        "e2__idm__2__scene_0__0.npz",
        "e2__idm__2__scene_0__1.npz",
    ]
    assert sorted(tmp_path.iterdir()) == sorted(paths), "no temporary file is left"
    for index, path in enumerate(paths):
        with np.load(path, allow_pickle=False) as archive:
            data = dict(archive)
        assert data.keys() == DTYPES.keys()
        for key, kind in DTYPES.items():
            assert data[key].dtype.kind == kind[0]
            assert len(kind) < 2 or data[key].dtype == kind, key
        assert str(data["format"]) == "e2rl-rollout/1"
        assert float(data["dt"]) == 0.1
        assert int(data["ego"]) == 0
        for name, least in (("lane", 2), ("drivable", 3)):
            offsets = data[f"{name}_offsets"]
            assert offsets[0] == 0
            assert offsets[-1] == len(data[f"{name}_points"])
            assert (np.diff(offsets) >= least).all()
        np.testing.assert_array_equal(data["states"], rollouts.states[index].numpy())


def test_rollouts_read_back_are_those_written_padded_where_others_are_longer(
    tmp_path, rollouts
):
    read = Rollouts.from_npz(rollouts.to_npz(tmp_path))
    for key in (
        "states",
        "valid",
        "size",
        "agent_type",
        "adversaries",
        "logged",
        "eta",
        "seed",
    ):
        torch.testing.assert_close(
            read.get(key),
            rollouts.get(key),
            equal_nan=True,
            rtol=0,
            atol=0,
        )
    for key in ("scene_id", "location", "method"):
        assert list(read.get(key)) == list(rollouts.get(key))
    short = random_rollouts(
        2,
        seed=2,
        steps=40,
        vehicles=6,
        others=1,
    )
    both = Rollouts.of([rollouts.rollout(0), short.rollout(1)])
    assert both.states.shape[1:3] == rollouts.states.shape[1:3]
    assert not both.valid[1, 41:].any()
    assert not both.valid[1, :, 7:].any()
    torch.testing.assert_close(
        both.states[1, :41, :7],
        short.states[1],
        equal_nan=True,
        rtol=0,
        atol=0,
    )
    for rows in (
        read[1:3],
        torch.cat([read[1:2], read[2:3]]),
        read[torch.tensor([False, True, True, False])],
    ):
        assert list(rows.scene_id) == ["scene_0", "scene_1"]
        assert torch.equal(rows.valid, read.valid[1:3])


def test_rollouts_of_other_maps_and_sizes_are_joined_and_score_as_before():
    """What one of them does not know, all together do not."""
    small = random_rollouts(
        2,
        seed=3,
        vehicles=4,
        others=1,
    )
    large = random_rollouts(
        3,
        seed=5,
        vehicles=7,
        others=2,
    )
    line = torch.tensor([[-50.0, 0.0], [0.0, 1.0], [50.0, 0.0]]).expand(2, -1, -1)
    small = small.replace(
        lane_points=line,
        lane_index=torch.zeros(2, 3, dtype=torch.int64),
        lane_width=torch.full((2, 1), 4.0),
        nfe=None,
    )
    joined = torch.cat([small, large])
    assert joined.nfe is None
    assert joined.lane_index[0, 3:].eq(-1).all()
    assert not joined.valid[:2, :, small.valid.shape[2] :].any()
    rows = score_rollouts(joined)[0]
    apart = score_rollouts(small)[0] + score_rollouts(large)[0]
    for row, alone in zip(rows, apart, strict=True):
        row["nfe"] = alone["nfe"]
        assert row == pytest.approx(
            alone,
            nan_ok=True,
            abs=1e-9,
        )


def test_plans_are_those_of_the_ego_and_of_adversaries_and_unknown_tracks_are_left_out(
    tmp_path, rollouts
):
    rows = rollouts.states.shape[2]
    plans = torch.arange(4.0 * 16 * rows * 10 * 2).reshape(4, 16, rows, 10, 2)
    targets = torch.where(rollouts.adversaries, 0, -1)[:, None].expand(-1, 16, -1)
    evasion = rollouts.states[:, :, 0].clone()
    driver = rollouts.states[:, :, 0] + 1
    evasion[1] = driver[2] = torch.nan
    further = rollouts.replace(
        plans=plans,
        targets=targets,
        evasion=evasion,
        driver=driver,
    )
    for index, path in enumerate(further.to_npz(tmp_path)):
        data = Rollout.read(path)
        planners = [0, *rollouts.adversaries[index].nonzero()[:, 0].tolist()]
        assert data.planners.tolist() == planners
        assert (data.evasion is None, data.driver is None) == (index == 1, index == 2)
        np.testing.assert_array_equal(data.plans, plans[index][:, planners].numpy())
        assert (data.targets[:, 0] == -1).all()
        assert (data.targets[:, 1:] == 0).all()


def test_scenes_tell_who_is_simulated_and_what_was_recorded():
    scenes = make_scenes(
        2,
        vehicles=[(0, 0, 5.0), (20, 0, 5.0)],
        num_vrus=1,
        steps=10,
    )
    scene = scenes.scenes
    further = {
        "adversaries": scene["valid"] & False,
        "seed": torch.arange(2),
        "eta": torch.zeros(2).double(),
    }
    built = Rollouts.in_scenes(
        scenes,
        torch.arange(2),
        states=scene["logged"],
        valid=scene["logged_valid"],
        **further,
    )
    assert torch.equal(
        built.simulated, scene["valid"] & (scene["agent_type"] == VEHICLE)
    )
    assert not built.logged_valid[:, :, ~scene["valid"][0]].any()
    assert list(built.scene_id) == scenes.scene_id
    replayed = Rollouts.in_scenes(
        scenes,
        torch.arange(2),
        states=built.states,
        valid=built.valid,
        replays_ego=True,
        **further,
    )
    assert not replayed.simulated[:, 0].any()
    assert torch.equal(replayed.simulated[:, 1:], built.simulated[:, 1:])


def test_a_failure_has_its_contact_and_a_rollout_without_one_has_none(
    tmp_path, rollouts
):
    rollouts[:1].to_npz(tmp_path / "rollouts")
    row = {
        "method": "e2",
        "ego_policy": "idm",
        "eta": 2.0,
        "scene_id": "scene_0",
        "seed": 0,
        "partner": 3,
    }
    failure = Failure.read(tmp_path, row | {"contact_step": 12.0})
    assert (failure.contact, failure.partner, failure.rollout.name) == (
        12,
        3,
        "e2__idm__2__scene_0__0.npz",
    )
    assert (
        Failure(failure.rollout, row | {"contact_step": float("nan")}).contact is None
    )


def test_lines_too_short_to_be_lines_are_left_out():
    points = torch.arange(12.0).reshape(6, 2)
    rest, offsets, numbers = polylines(
        points, torch.tensor([0, 0, 3, 4, 4, -1]), minimum=2
    )
    assert numbers.tolist() == [0, 4]
    assert offsets.tolist() == [0, 2, 4]
    assert rest.tolist() == points[[0, 1, 3, 4]].tolist()
    empty, offsets, _ = polylines(
        points[:0], torch.zeros(0, dtype=torch.int64), minimum=3
    )
    assert empty.shape == (0, 2)
    assert offsets.tolist() == [0]


def test_names_that_no_path_may_hold_are_mended(tmp_path, rollouts):
    path = rollouts[:1].replace(scene_id=["a/../b c"]).to_npz(tmp_path)[0]
    assert path.parent == tmp_path
    assert path.name.startswith("e2__idm__2__a-..-b-c__0~")
    assert Rollout.read(path).scene_id == "a/../b c"


@settings(
    max_examples=60,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture],
)
@given(
    st.lists(
        st.tuples(st.floats(0, 1, exclude_max=True), st.integers(0, 255)),
        min_size=1,
        max_size=6,
    ),
    st.floats(0.3, 1),
)
def test_a_damaged_rollout_is_refused_by_name(
    tmp_path,
    rollouts,
    changes,
    kept,
):
    """Only bytes that say nothing may be changed: then the arrays are the same."""
    path = rollouts[:1].to_npz(tmp_path)[0]
    whole = Rollout.read(path)
    content = path.read_bytes()
    damaged = bytearray(content[: int(kept * len(content)) + 1])
    for where, value in changes:
        damaged[int(where * len(damaged))] = value
    path.write_bytes(damaged)
    try:
        result = Rollout.read(path)
    except InputError as error:
        assert str(error).startswith(str(path))
    else:
        np.testing.assert_equal(vars(result), vars(whole))  # NaN equals NaN


@pytest.mark.parametrize(
    ("name", "value", "what"),
    [
        ("states", np.zeros((81, 48, 3), np.float32), "states has shape"),
        ("seed", np.array(1e300), "seed is no single number"),
        ("lane_width", np.full(3, np.nan, np.float32), "as many lanes as borders"),
        ("plans", np.zeros((16, 1, 10, 2), np.float32), "some are missing"),
    ],
)
def test_arrays_that_do_not_fit_together_are_named(
    tmp_path,
    rollouts,
    name,
    value,
    what,
):
    path = rollouts[:1].to_npz(tmp_path)[0]
    np.savez(path, **(dict(np.load(path)) | {name: value}))
    with pytest.raises(InputError, match=rf"npz: damaged: .*{what}"):
        Rollout.read(path)


def test_an_archive_that_claims_more_than_it_may_is_not_unpacked(tmp_path):
    with (
        zipfile.ZipFile(
            tmp_path / "bomb.npz", "w", zipfile.ZIP_DEFLATED, compresslevel=1
        ) as archive,
        archive.open("states.npy", "w") as single,
    ):
        for _ in range(1025):
            single.write(bytes(1 << 20))
    with pytest.raises(
        InputError, match=r"bomb\.npz: no readable rollout .unpacks to 1075 MB"
    ):
        Rollout.read(tmp_path / "bomb.npz")
    claim = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        claim, {"descr": "<f8", "fortran_order": False, "shape": (1 << 60,)}
    )
    with zipfile.ZipFile(tmp_path / "claim.npz", "w") as archive:
        archive.writestr("states.npy", claim.getvalue())
    with pytest.raises(InputError, match=r"claim\.npz: no readable rollout"):
        Rollout.read(tmp_path / "claim.npz")
