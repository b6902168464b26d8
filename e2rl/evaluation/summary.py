"""The rows of metrics.json: one per (dataset, split, method, ego, eta), with paired differences to other methods."""

from collections.abc import Sequence

from torch import Tensor

from e2rl.evaluation.files import command_line, git_commit
from e2rl.metrics.statistics import DRAWS, REALISM_DRAWS, paired_differences, summarise

GROUP = ("dataset", "split", "method", "ego_policy", "eta")


def metric_rows(
    rows: Sequence[dict],
    features: Sequence[dict[str, Tensor]],
    command: str | None = None,
    draws: int = DRAWS,
    realism_draws: int = REALISM_DRAWS,
    **fields: object,
) -> list[dict]:
    """Rows of metrics.json from the labelled rows (`files.label_rows`) of many methods and the features beside them.

    A row's `paired` compares it with every other method (or eta) on the same dataset, split and ego over the shared
    (scene, seed); a method there with several etas is named method@eta. `fields` (e.g. stage="before") join each row.
    """
    groups: dict[tuple, list[int]] = {}
    for index, row in enumerate(rows):
        groups.setdefault(tuple(row[key] for key in GROUP), []).append(index)
    origin = {"git": git_commit(), "command": command_line() if command is None else command}
    result = []
    for key, members in groups.items():
        ours = [[source[index] for index in members] for source in (rows, features)]
        paired = {}
        for other in rivals(key, list(groups)):
            theirs = [[source[index] for index in groups[other]] for source in (rows, features)]
            paired[rival_name(other, list(groups))] = paired_differences(*ours, *theirs, draws, realism_draws)
        dataset, split, method, ego, eta = key
        scenes, seeds = ({row[name] for row in ours[0]} for name in ("scene_id", "seed"))
        counts = {"n_scenes": len(scenes), "n_seeds": len(seeds), "n_rollouts": len(members)}
        result.append(
            {
                "dataset": dataset,
                "split": split,
                "method": method,
                "ego": ego,
                "eta": eta,
                **counts,
                **origin,
                **fields,
                "metrics": summarise(*ours, draws, realism_draws),
                "paired": paired,
            }
        )
    return result


def rivals(key: tuple, keys: Sequence[tuple]) -> list[tuple]:
    """The other groups on the same dataset and split with the same ego."""
    place = GROUP.index("method")
    return [
        other for other in keys if other != key and other[:place] == key[:place] and other[place + 1] == key[place + 1]
    ]


def rival_name(key: tuple, keys: Sequence[tuple]) -> str:
    """The group's method, with its eta where the method occurs with several beside the same ego."""
    dataset, split, method, ego, eta = key
    etas = {other[4] for other in keys if other[:4] == key[:4]}
    return method if len(etas) == 1 else f"{method}@{eta:g}"
