"""A stranger's run folder runs no code, starts no program and sends no key that the command line does not name."""

import pytest
from omegaconf import OmegaConf

from e2rl.run.config import choices, load_choice, load_config
from e2rl.run.errors import InputError
from e2rl.run.trust import CONFIG, check_code, outside_modules, saved_configuration

TRAIN, EVALUATE = (OmegaConf.create(OmegaConf.to_container(load_config(name))) for name in ("train", "evaluate"))
POLICY_FILE = "e2rl.planners.policy_file.PolicyFileEgo"


def with_choice(group, name, **changes):
    return {group: OmegaConf.merge(OmegaConf.create(OmegaConf.to_container(load_choice(group, name))), changes)}


@pytest.mark.parametrize("config", [TRAIN, EVALUATE])
def test_a_run_of_ones_own_goes_on(config):
    check_code(config, [], "resume=x")


@pytest.mark.parametrize("group", ["learner", "ego", "curriculum", "synthesizer"])
def test_every_file_of_ones_own_goes_on(group):
    for name in set(choices(group)) - {"external", "policy_file"}:
        check_code(OmegaConf.merge(TRAIN, with_choice(group, name)), [], "resume=x")


def test_a_policy_that_holds_arithmetic_goes_on():
    check_code(OmegaConf.merge(EVALUATE, {"ego": {"_target_": POLICY_FILE, "file": "x.onnx"}}), [], "x")


@pytest.mark.parametrize(
    "changes",
    [
        {"ego": {"_target_": "os.system", "command": "true"}},
        {"data": {"_target_": "torch.load"}},
        {"synthesizer": {"deep": [{"x": [{"_target_": "pickle.loads"}]}]}},
        {"ego": {"_target_": "e2rl.run.files.write_atomically"}},  # a function of e2rl
        {"ego": {"_target_": "e2rl.learning.memory.Memory"}},  # a class of e2rl that is no extension
        {"ego": {"_target_": "e2rl.run.run.subprocess.Popen"}},  # by way of a module that imports it
        {"ego": {"_target_": "e2rl.evaluation.ego_set.Ego"}},  # an extension, but not where it is defined
        {"ego": {"_target_": "e2rl.scripts.train.run"}},
        {"ego": {"_target_": "e2rl.no.such.Class"}},
        {"ego": {"_target_": "${seed}"}},
        {"ego": {"x": "${oc.decode:'{_target_: os.system}'}"}},
        {"ego": {"x": r"\${oc.decode:'{_target_: os.system}'}"}},
        {"methods": ["${hydra:job.name}"]},
        {"plugins": ["this"]},
        {"variants": {"x": {"synthesizer._target_": "os.system"}}},  # a change's key is a path
        {"variants": {"x": {"synthesizer[_target_]": "os.system"}}},
        {"egos": {"x": {"ego": "idm", "teacher._target_": ["os.system"]}}},
        with_choice("ego", "external", command="true"),  # a program of the stranger's
        with_choice("ego", "external", command=["true"]),
        with_choice("ego", "external", address="else:1"),
        {"egos": {"x": {"ego": "external", "[address]": "else:1"}}},
        {"ego": {"_target_": POLICY_FILE, "file": "policy.pt"}},  # a TorchScript file is a program
        {"egos": {"x": {"ego": "policy_file", "file": "policy.pt"}}},
    ],
)
def test_code_from_elsewhere_needs_the_users_consent(changes):
    with pytest.raises(InputError, match="runs code that is no extension of e2rl: .*plugins="):
        check_code(OmegaConf.merge(EVALUATE, changes), ["my_stack"], "resume=x")


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
        check_code(OmegaConf.merge(EVALUATE, place(key)), ["my_stack"], "resume=x")


def test_modules_that_the_command_line_names_take_part():
    mine = {"ego": {"_target_": "my_stack.cruise.Cruise"}, "plugins": ["my_stack.hard_braking"]}
    config = OmegaConf.merge(TRAIN, mine)
    check_code(config, ["my_stack"], "resume=x")
    check_code(config, ["my_stack.cruise", "my_stack.hard_braking"], "resume=x")
    with pytest.raises(InputError, match="my_stack.hard_braking"):
        check_code(config, ["my_stack.cruise", "my_stack_of_others"], "resume=x")
    external = OmegaConf.merge(EVALUATE, with_choice("ego", "external", command="true"))
    assert outside_modules(external) == {"e2rl.planners.external"}
    check_code(external, ["e2rl.planners.external"], "resume=x")


@pytest.mark.parametrize("name", ["../../stranger/evil", "/tmp/evil", "a/../b", ".hidden", "nominal,e2", "${x}", ""])
def test_a_group_s_file_is_in_its_folder(name):
    """Methods and egos of a stranger's run name files of the user's own configuration only."""
    with pytest.raises(InputError, match="no name of a file in conf/synthesizer"):
        load_choice("synthesizer", name)


def written(folder, content):
    (folder / CONFIG).parent.mkdir(parents=True)
    (folder / CONFIG).write_bytes(content if isinstance(content, bytes) else OmegaConf.to_yaml(content).encode())
    return folder


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"a: [", "damaged"),
        (b"\xff\xfe\x00", "damaged"),
        (b"!!python/object/apply:os.system ['true']", "damaged"),
        (b"a: " + b"[" * 5000, "damaged"),
        (b"[1, 2]", "no configuration of a run"),
        (b"stage: prior\nseed: 0\n", "missing"),
        (TRAIN, "of the other command.* methods"),
    ],
)
def test_a_configuration_that_is_none_is_named(tmp_path, content, what):
    with pytest.raises(InputError, match=rf"config\.yaml: .*{what}"):
        saved_configuration(EVALUATE, written(tmp_path, content), "resume=x")


@pytest.mark.parametrize(
    "changes",
    [
        {"synthesizer": {"reasoner": {"base_url": "http://else"}}},
        {"variants": {"x": {"synthesizer.reasoner.base_url": "http://else"}}},
    ],
)
def test_an_endpoint_gets_no_key_unasked(tmp_path, changes):
    written(tmp_path, OmegaConf.merge(EVALUATE, changes))
    with pytest.raises(InputError, match="sends your API key to http://else"):
        saved_configuration(EVALUATE, tmp_path, "resume=x")
    agreed = OmegaConf.merge(EVALUATE, {"synthesizer": {"reasoner": {"base_url": "http://else"}}})
    assert saved_configuration(agreed, tmp_path, "resume=x")
