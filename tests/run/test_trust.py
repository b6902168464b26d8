"""A stranger's run folder runs no code, starts no program, sends no key and writes
nowhere that the command line does not name, and takes little to read."""

import os

import pytest
from omegaconf import OmegaConf

from e2rl.run.config import choices, load_choice, load_config
from e2rl.run.errors import InputError
from e2rl.run.trust import (
    CONFIG,
    check_code,
    check_written,
    outside_modules,
    saved_configuration,
    written_outside,
)

POLICY_FILE = "e2rl.planners.policy_file.PolicyFileEgo"


def plain(config):
    return OmegaConf.create(OmegaConf.to_container(config))


TRAIN, EVALUATE, TUNE = (
    plain(load_config(name)) for name in ("train", "evaluate", "tune")
)
changed = OmegaConf.merge


def with_choice(group, name, **changes):
    return {group: changed(plain(load_choice(group, name)), changes)}


def written(folder, content):
    (folder / CONFIG).parent.mkdir(parents=True, exist_ok=True)
    (folder / CONFIG).write_bytes(
        content if isinstance(content, bytes) else OmegaConf.to_yaml(content).encode()
    )
    return folder


def reading(folder, content, config=EVALUATE):
    return saved_configuration(config, written(folder, content), where="resume=x")


@pytest.mark.parametrize("config", [TRAIN, EVALUATE, TUNE])
def test_a_run_of_ones_own_goes_on(tmp_path, config):
    saved = reading(tmp_path, config, config=config)
    assert saved == config
    check_written(saved, tmp_path, "resume=x", config)


def test_a_run_of_a_version_without_an_option_that_is_off_goes_on(tmp_path):
    earlier = changed(EVALUATE, {})
    del earlier["failure"]
    assert reading(tmp_path, earlier, config=EVALUATE) == EVALUATE
    with pytest.raises(InputError, match="failure: missing"):
        reading(tmp_path, earlier, config=changed(EVALUATE, {"failure": "one"}))


@pytest.mark.parametrize("group", ["learner", "ego", "curriculum", "synthesizer"])
def test_every_file_of_ones_own_goes_on(tmp_path, group):
    for name in set(choices(group)) - {"class", "external", "nuplan", "policy_file"}:
        ours = changed(TRAIN, with_choice(group, name))
        assert reading(tmp_path, ours, config=TRAIN) == ours, name


@pytest.mark.parametrize(
    "changes",
    [
        {"ego": {"_target_": "os.system", "command": "true"}},
        {"data": {"_target_": "torch.load"}},
        {"synthesizer": {"deep": [{"x": [{"_target_": "pickle.loads"}]}]}},
        {"ego": {"_target_": "e2rl.run.files.write_atomically"}},  # a function of e2rl
        {
            "ego": {"_target_": "e2rl.learning.rounds.memory.Memory"}
        },  # a class of e2rl that is no extension
        {
            "ego": {"_target_": "e2rl.run.run.subprocess.Popen"}
        },  # by way of a module that imports it
        {
            "ego": {"_target_": "e2rl.evaluation.build.Ego"}
        },  # an extension, but not where it is defined
        {"ego": {"_target_": "e2rl.scripts.train.run"}},
        {"ego": {"_target_": "e2rl.no.such.Class"}},
        {"ego": {"_target_": "${seed}"}},
        {"plugins": ["this"]},
        {
            "variants": {"x": {"synthesizer._target_": "os.system"}}
        },  # a change's key is a path
        {"variants": {"x": {"synthesizer[_target_]": "os.system"}}},
        {"egos": {"x": {"ego": "idm", "teacher._target_": ["os.system"]}}},
        with_choice("ego", "external", command="true"),  # a program of the stranger's
        with_choice("ego", "external", command=["true"]),
        with_choice("ego", "external", address="else:1"),
        {"egos": {"x": {"ego": "external", "[address]": "else:1"}}},
        {
            "ego": {"_target_": POLICY_FILE, "file": "policy.pt"}
        },  # a TorchScript file is a program
        {"egos": {"x": {"ego": "policy_file", "file": "policy.pt"}}},
    ],
)
def test_code_from_elsewhere_needs_the_users_consent(changes):
    with pytest.raises(
        InputError, match="runs code that is no extension of e2rl: .*plugins="
    ):
        check_code(changed(EVALUATE, changes), ["my_stack"], where="resume=x")


@pytest.mark.parametrize("key", ["_args_", "_partial_", "_other_"])
@pytest.mark.parametrize(
    "place",
    [
        lambda key: {"ego": {key: 1}},
        lambda key: {"data": {"x": [{key: {}}]}},
        lambda key: {"variants": {"x": {f"a.{key}": 1}}},
    ],
)
def test_of_hydras_keys_a_saved_configuration_has_targets_only(key, place):
    with pytest.raises(InputError, match=f"its configuration has {key}, which no run"):
        check_code(changed(EVALUATE, place(key)), ["my_stack"], where="resume=x")


def test_modules_that_the_command_line_names_take_part():
    mine = {
        "ego": {"_target_": "my_stack.cruise.Cruise"},
        "plugins": ["my_stack.hard_braking"],
    }
    config = changed(TRAIN, mine)
    check_code(config, ["my_stack"], where="resume=x")
    check_code(config, ["my_stack.cruise", "my_stack.hard_braking"], where="resume=x")
    with pytest.raises(InputError, match="my_stack.hard_braking"):
        check_code(config, ["my_stack.cruise", "my_stack_of_others"], where="resume=x")
    external = changed(EVALUATE, with_choice("ego", "external", command="true"))
    assert outside_modules(external) == {"e2rl.planners.external"}
    check_code(external, ["e2rl.planners.external"], where="resume=x")


@pytest.mark.parametrize(
    "name",
    ["../../stranger/evil", "/tmp/evil", "a/../b", ".hidden", "nominal,e2", "${x}", ""],
)
def test_a_group_s_file_is_in_its_folder(name):
    """Methods and egos of a stranger's run name files of the user's own configuration
    only."""
    with pytest.raises(InputError, match="no name of a file in conf/synthesizer"):
        load_choice("synthesizer", name)


LINES = (
    "\n".join(f"a{k}: '${{a{k + 1}}}${{a{k + 1}}}'" for k in range(40)) + "\na40: x\n"
)
ALIASES = "a0: &a0 [x]\n" + "\n".join(
    f"a{k + 1}: &a{k + 1} [{', '.join([f'*a{k}'] * 9)}]" for k in range(9)
)
RUN = OmegaConf.to_yaml(EVALUATE)


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"a: [", "damaged"),
        (b"\xff\xfe\x00", "damaged"),
        (b"!!python/object/apply:os.system ['true']", "damaged"),
        (b"a: " + b"[" * 5000, "damaged"),
        (b"a: " + b"x" * 300_000, "damaged .*larger than"),
        (b"a: [" + b"x, " * 50_000 + b"]", "damaged .*more than a run's"),
        ((RUN + ALIASES).encode(), "damaged .*aliases"),
        ((RUN + LINES).encode(), "damaged .*refers to what refers to others"),
        (
            changed(EVALUATE, {"x": "${oc.decode:'{_target_: os.system}'}"}),
            "refers to more than a key",
        ),
        (
            changed(EVALUATE, {"x": r"\${oc.decode:'{_target_: os.system}'}"}),
            "refers to more than a key",
        ),
        (
            changed(EVALUATE, {"x": "${y}${z}", "y": "$", "z": "{oc.env:HOME}"}),
            "refers to what",
        ),
        (changed(EVALUATE, {"methods": ["${hydra:job.name}"]}), "refers to more"),
        (changed(EVALUATE, {"x": "${sim}${sim}"}), "sim, which is no plain"),
        (changed(EVALUATE, {"x": "${nothing}"}), "nothing, which is no plain"),
        ((RUN + "x: 0x" + "f" * 10_000).encode(), "x is an endless number"),
        (b"[1, 2]", "no configuration of a run"),
        (b"stage: prior\nseed: 0\n", "missing"),
        (TRAIN, "of the other command.* methods"),
    ],
)
def test_a_configuration_that_is_none_is_named_before_it_grows(tmp_path, content, what):
    with pytest.raises(InputError, match=rf"config\.yaml: .*{what}"):
        reading(tmp_path, content)


@pytest.mark.parametrize(
    "name", [str(CONFIG), "parts", "rollouts", "checkpoints/round-000001", "parts/a.pt"]
)
@pytest.mark.parametrize("kind", ["link", "pipe", "device"])
def test_links_out_of_the_folder_pipes_and_devices_are_refused(tmp_path, name, kind):
    folder = written(tmp_path / "run", EVALUATE)
    outside = tmp_path / "mine"
    outside.write_text(RUN)
    (folder / "wandb").mkdir()
    (folder / "wandb" / "debug.log").symlink_to(outside)  # as wandb does
    (folder / "latest").symlink_to(folder / "wandb")
    saved_configuration(EVALUATE, folder, where="resume=x")
    place = folder / name
    place.parent.mkdir(parents=True, exist_ok=True)
    place.unlink(missing_ok=True)
    os.mkfifo(place) if kind == "pipe" else place.symlink_to(
        outside if kind == "link" else "/dev/zero"
    )
    with pytest.raises(InputError, match="a link out of|no regular file|no run found"):
        saved_configuration(EVALUATE, folder, where="resume=x")


@pytest.mark.parametrize(
    "changes",
    [
        {"synthesizer": {"reasoner": {"base_url": "http://else"}}},
        {"variants": {"x": {"synthesizer.reasoner.base_url": "http://else"}}},
    ],
)
def test_an_endpoint_gets_no_key_unasked(tmp_path, changes):
    content = changed(EVALUATE, changes)
    with pytest.raises(InputError, match="sends your API key to http://else"):
        reading(tmp_path, content)
    agreed = changed(
        EVALUATE, {"synthesizer": {"reasoner": {"base_url": "http://else"}}}
    )
    assert reading(tmp_path, content, config=agreed)


@pytest.mark.parametrize(
    ("changes", "option"),
    [
        ({"data": {"cache": "{}"}}, "data.cache={}"),
        (
            {"data": {"cache_gb": 0}},
            "data.cache_gb=0",
        ),  # of the user's cache nothing would be left
        ({"tuning": {"study": "{}"}}, "tuning.study={}"),
        (
            {"synthesizer": {"reasoner": {"cache": "{}"}}},
            "synthesizer.reasoner.cache={}",
        ),
        (
            {"variants": {"x": {"synthesizer.reasoner.cache": "{}"}}},
            "synthesizer.reasoner.cache={}",
        ),
        ({"data": {"cache": "${resume}"}, "resume": "{}"}, "data.cache={}"),
    ],
)
def test_paths_to_write_to_are_in_the_folder_or_on_the_command_line(
    tmp_path, changes, option
):
    """Links count by where they lead; the option that is told is the one that goes on."""

    def at(path):
        return changed(
            TUNE, OmegaConf.create(OmegaConf.to_yaml(changes).replace("{}", str(path)))
        )

    run = tmp_path / "run"
    outside = tmp_path / "else"
    run.mkdir()
    outside.mkdir()
    (run / "link").symlink_to(outside)
    for path in (outside, run / "link" / "x", run / ".." / "else", "/dev/null"):
        with pytest.raises(InputError, match="writes outside of its folder") as refused:
            check_written(at(path), run, "resume=x", TUNE)
        added = option.format(path)
        assert str(refused.value).endswith(f"add {added}")
        check_written(at(path), run, "resume=x", TUNE, OmegaConf.from_dotlist([added]))
    if "{}" in option:
        check_written(at(run / "inside"), run, "resume=x", TUNE)
    assert written_outside(TUNE, run, TUNE) == []
