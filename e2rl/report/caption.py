"""What stands in every table's caption: the settings that all methods share, and what
each knows of the ego and owes it."""

from collections.abc import Mapping, Sequence

from omegaconf import DictConfig

from e2rl.driving.setup import Method


def caption(config: DictConfig, origin: Mapping, methods: Sequence[Method] = ()) -> str:
    """Returns the caption of a run's tables.

    Args:
        config: of the run.
        origin: of the prior, from its checkpoint.
        methods: whose terms are told.
    """
    prior = config.prior
    sampler = prior.sampler
    bounds = [name for name in ("meeting", "curve") if prior.bounds[name]]
    changes = [
        f"; {name}: {change}".replace("'", "")
        for name, change in config.get("variants", {}).items()
    ]
    return (
        f"Prior {prior.checkpoint} ({origin.get('data', 'unknown data')}); "
        f"{sampler.sampler}, K = {sampler.steps}, temperature {sampler.temperature:g} "
        f"(routes {sampler.route_temperature:g}), one sample a replan, replanned every "
        f"0.5 s; acceleration bounds: {', '.join(bounds) or 'none'}{''.join(changes)}"
        f"{terms(methods)}"
    )


def terms_by_method(methods: Sequence[Method]) -> dict[str, tuple[str, str]]:
    """Returns what each method knows of the ego and owes it."""
    return {
        method.name: (method.traffic.knowledge, method.traffic.responsibility)
        for method in methods
    }


def terms(methods: Sequence[Method]) -> str:
    """Returns what methods know of the ego and owe it, for a caption; "" for those that
    have no such settings."""
    by_terms: dict[str, list[str]] = {}
    for name, (knowledge, responsibility) in terms_by_method(methods).items():
        parts = []
        if knowledge:
            predicted = knowledge == "predicted"
            parts.append(
                f"the ego {'predicted' if predicted else 'announces its plan'}"
            )
        if responsibility:
            parts.append(f"responsibility {responsibility}")
        if parts:
            by_terms.setdefault(", ".join(parts), []).append(name)
    return "".join(f"; {', '.join(names)}: {text}" for text, names in by_terms.items())
