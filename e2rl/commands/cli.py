"""`e2rl COMMAND ...`: all commands under one name."""

import e2rl.run.early  # noqa: F401 - first: from here on Ctrl-C ends in one line

# isort: split
import sys
from difflib import get_close_matches
from importlib import import_module
from importlib.metadata import version

COMMANDS = {  # module, and what the command does
    "try": (
        "e2rl.commands.try_planner",
        "how a planner class of your own fails, without a YAML file",
    ),
    "evaluate": (
        "e2rl.scripts.evaluate",
        "how often, and how, an ego fails in attacked traffic",
    ),
    "check": (
        "e2rl.commands.check",
        "what would go wrong in a long run: of the planner, the data, the machine",
    ),
    "train": (
        "e2rl.scripts.train",
        "improve a policy on the failures that are found; train a prior",
    ),
    "tune": ("e2rl.commands.tune", "tune the parameters of an adversary or a planner"),
    "rate": (
        "e2rl.commands.rate",
        "how often an ego fails in traffic as the prior has it",
    ),
    "cross": (
        "e2rl.commands.cross",
        "how far failures of one planner are failures of others",
    ),
    "report": (
        "e2rl.commands.report",
        "the page with a replay of every failure of a run",
    ),
    "replay": ("e2rl.commands.replay", "videos and pictures of rollouts of a run"),
    "export": (
        "e2rl.commands.export",
        "failures of a run in the format of another tool",
    ),
    "export-policy": (
        "e2rl.commands.export_policy",
        "a trained actor as a TorchScript file",
    ),
    "inspect": (
        "e2rl.commands.inspect",
        "what a data set holds, and a picture of a scene",
    ),
    "compare": (
        "e2rl.commands.compare",
        "which failures of one run, or ego, are new or gone in another",
    ),
    "gate": (
        "e2rl.commands.gate",
        "whether a run keeps within limits, for continuous integration",
    ),
    "power": (
        "e2rl.commands.power",
        "how many scenes it takes to see that failures became rarer",
    ),
    "merge": ("e2rl.commands.merge", "join the shards of an evaluation"),
}
CONFIGURED = ("evaluate", "train", "tune", "rate", "cross")  # by conf/<name>.yaml
EXAMPLES = """examples:
  e2rl try LOGS --planner my_planner.py:MyPlanner --scenes 12
  e2rl check ego=sampling                        ten seconds before a long run
  e2rl evaluate num_scenes=12                    the lane-graph planner on twelve bundled scenes
  e2rl evaluate ego=idm eta=[1,2] metrics=all    another ego, two intensities, all tables
  e2rl report runs/evaluate/DATE/TIME            watch its failures
  e2rl export runs/evaluate/DATE/TIME --to openscenario
  e2rl train rounds=4                            four rounds of evolution
  e2rl evaluate --help                           every option, with its comment

Ctrl-C ends a command in one line, which says how to go on with it."""


def help_text() -> str:
    """Returns the list of commands, with examples."""
    width = max(map(len, COMMANDS))
    lines = [f"  {name.ljust(width)}  {about}" for name, (_, about) in COMMANDS.items()]
    return "\n".join(["usage: e2rl COMMAND ... | --version", "", *lines, "", EXAMPLES])


def main() -> None:
    """The command."""
    name = sys.argv[1] if len(sys.argv) > 1 else "--help"
    arguments = sys.argv[2:]
    if name in ("-h", "--help", "help"):
        print(help_text())
    elif name in ("-V", "--version", "version"):
        print(f"e2rl {version('e2rl')}")
    elif name in COMMANDS:
        sys.argv = [f"e2rl {name}", *arguments]
        if name in CONFIGURED and {"-h", "--help"} & set(arguments):
            options = import_module(
                "e2rl.run.options"
            )  # without the command's libraries
            print(options.help_text(name, arguments))
            return
        import_module(COMMANDS[name][0]).main()
    else:
        near = get_close_matches(name, COMMANDS, 1, 0.4)
        advice = f"did you mean {near[0]}?" if near else "see e2rl --help"
        print(f"error: e2rl {name}: no such command; {advice}", file=sys.stderr)
        sys.exit(2)


if __name__ == "__main__":
    main()
