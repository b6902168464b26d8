"""resume=RUN_DIR: a run's own configuration goes on; a stranger's runs no code that the command line does not name."""

import pytest
from omegaconf import OmegaConf

from e2rl.build import load_choice, load_config
from e2rl.errors import InputError
from e2rl.learning.resume import check_code, resumed

OURS = load_config("train")


def stranger(**changes):
    """A training configuration with changes at dotted keys."""
    config = OmegaConf.create(OmegaConf.to_container(OURS))
    for key, value in changes.items():
        OmegaConf.update(config, key.replace("__", "."), value, force_add=True)
    return config


@pytest.mark.parametrize(
    ("group", "name"),
    [
        *(("learner", name) for name in ("ppo_bc", "planner_tuning")),
        *(("ego", name) for name in ("actor", "lane_graph", "sampling", "idm", "replay")),
        *(("data", name) for name in ("bundled", "scenarionet", "procedural")),
        *(("curriculum", name) for name in ("adaptive", "bandit", "constant", "linear")),
        *(("synthesizer", name) for name in ("e2", "nominal", "replay", "idm", "constant_velocity")),
    ],
)
def test_every_group_of_ones_own_goes_on(group, name):
    check_code(stranger(**{group: load_choice(group, name)}), [], "resume=x")


@pytest.mark.parametrize(
    "changes",
    [
        {"ego": {"_target_": "os.system", "command": "true"}},
        {"ego": {"_target_": "builtins.eval"}},
        {"data___target_": "torch.load"},
        {"learner__teacher": {"_target_": "subprocess.Popen", "args": "true"}},
        {"synthesizer__deep": [{"x": [{"_target_": "pickle.loads"}]}]},
        {"ego___target_": "e2rl.files.write_atomically"},  # a function of e2rl
        {"ego___target_": "e2rl.learning.memory.Memory"},  # a class of e2rl that is no extension
        {"ego___target_": "e2rl.evaluation.files.subprocess.Popen"},  # by way of a module that imports it
        {"ego___target_": "e2rl.learning.build.ActorEgo"},  # an extension, but not where it is defined
        {"ego___target_": "e2rl.commands.train.run"},
        {"ego___target_": "e2rl.no.such.Class"},
        {"ego___target_": "${seed}"},
        {"ego__x": "${oc.decode:'{_target_: os.system}'}"},
        {"ego__x": r"\${oc.decode:'{_target_: os.system}'}"},
        {"plugins": ["this"]},
    ],
)
def test_code_from_elsewhere_needs_the_users_consent(changes):
    with pytest.raises(
        InputError, match=r"^resume=x: its configuration runs code that is no extension of e2rl: .*plugins="
    ):
        check_code(stranger(**changes), ["my_stack"], "resume=x")


def test_modules_that_the_command_line_names_take_part():
    config = stranger(ego___target_="my_stack.cruise.Cruise", plugins=["my_stack.hard_braking"])
    check_code(config, ["my_stack"], "resume=x")
    check_code(config, ["my_stack.cruise", "my_stack.hard_braking"], "resume=x")
    with pytest.raises(InputError, match="my_stack.hard_braking"):
        check_code(config, ["my_stack.cruise", "my_stack_of_others"], "resume=x")


@pytest.mark.parametrize(
    ("content", "what"),
    [
        (b"a: [", "damaged"),
        (b"\xff\xfe\x00", "damaged"),
        (b"!!python/object/apply:os.system ['true']", "damaged"),
        (b"a: " + b"[" * 5000, "damaged"),
        (b"[1, 2]", "no configuration of a training run"),
        (b"", "no configuration of a training run"),
    ],
)
def test_a_configuration_that_is_none_is_named(tmp_path, content, what):
    (tmp_path / ".hydra").mkdir()
    (tmp_path / ".hydra" / "config.yaml").write_bytes(content)
    config = OmegaConf.merge(OURS, {"resume": str(tmp_path)})
    with pytest.raises(InputError, match=rf"config\.yaml: {what}"):
        resumed(config, tmp_path)


def test_an_endpoint_gets_no_key_unasked(tmp_path):
    (tmp_path / ".hydra").mkdir()
    OmegaConf.save(stranger(synthesizer__reasoner__base_url="http://else"), tmp_path / ".hydra" / "config.yaml")
    with pytest.raises(InputError, match="sends your API key to http://else"):
        resumed(OmegaConf.merge(OURS, {"resume": str(tmp_path)}), tmp_path)
