"""Which pieces of a simulation become scenes: an ego that meets others, and only
physically sound traffic."""

from collections import Counter

import numpy as np

from e2rl.scenes.bundled import CURRENT, FRAMES
from e2rl.scenes.recording import Recording
from scenegen.archive import Place
from scenegen.interaction import (
    interaction_score,
    lateral_acceleration,
    overlapping_pairs,
)

STRIDE = 40  # frames between the windows that are looked at
TRAVEL, BORDER, LATERAL = (
    20.0,
    35.0,
    5.0,
)  # m the ego drives, m it keeps from the map's border, m/s^2
RADIUS, MOST, MOST_PARKED, LEAST = (
    110.0,
    40,
    14,
    4,
)  # m around the ego; vehicles, parked cars; moving vehicles needed
ATTEMPTS = 12


def candidates(states, valid, border: np.ndarray, rng) -> list[tuple[float, int, int]]:
    """(score, first frame, vehicle) of the possible egos, best first."""
    found = []
    for first in range(0, len(states) - FRAMES + 1, STRIDE):
        span = slice(first, first + FRAMES)
        here = np.flatnonzero(valid[span].any(0))
        part = states[span, here]
        known = valid[span, here]
        score = interaction_score(part, known)
        travelled = np.linalg.norm(
            np.diff(part[CURRENT : CURRENT + 81, :, :2], axis=0), axis=-1
        ).sum(0)
        apart = np.linalg.norm(part[..., None, :2] - border, axis=-1).min(-1).min(0)
        good = (
            known.all(0)
            & (travelled > TRAVEL)
            & (part[..., 3].max(0) > 3.0)
            & (apart >= BORDER)
        )
        noise = rng.gumbel(size=len(here))
        found += [
            (float(score[k] + noise[k]), first, int(here[k]))
            for k in np.flatnonzero(good)
        ]
    return sorted(found, reverse=True)


def participants(states, valid, parked: int, ego: int) -> np.ndarray:
    """The ego, then the nearest vehicles at the start frame; parked cars are the last
    `parked` columns."""
    now = states[CURRENT, :, :2]
    apart = np.linalg.norm(now - now[ego], axis=-1)
    apart[~valid[CURRENT] | (apart > RADIUS)] = np.inf
    apart[ego] = -1.0
    at_kerb = np.arange(len(apart)) >= len(apart) - parked
    order = np.argsort(np.where(at_kerb, apart, np.inf), kind="stable")[MOST_PARKED:]
    apart[order[at_kerb[order]]] = np.inf
    near = np.argsort(apart, kind="stable")[:MOST]
    return near[np.isfinite(apart[near])]


def flaw(states, valid, size) -> str | None:
    """Why traffic [F, A] cannot be a scene, or None."""
    if (valid[CURRENT] & (states[..., 3].max(0) > 1.0)).sum() < LEAST:
        return "few vehicles"
    if len(overlapping_pairs(states, valid, size)):
        return "overlap"
    if np.abs(lateral_acceleration(states, valid)).max() > LATERAL:
        return "lateral acceleration"
    moving = np.where(valid, states[..., 3], np.nan)
    if np.nanmedian(moving) > 14.0 and np.nanmin(moving) < 3.0:
        return "stuck beside fast traffic"
    return None


def cut_windows(
    scene_map: Place, states, valid, size, border, most: int, rng
) -> tuple[list[tuple[Recording, int]], Counter[str]]:
    """Up to `most` (Recording, first frame) of a simulation, of different egos and at
    least 5.5 s apart, and why others were refused."""
    parked = np.zeros((len(states), len(scene_map.parked), 4))
    parked[..., :3] = scene_map.parked
    kept = []
    refused = Counter()
    egos = set()
    for _, first, ego in candidates(states, valid, border, rng):
        if len(kept) == most or sum(refused.values()) >= ATTEMPTS:
            break
        if ego in egos or any(abs(first - other) < FRAMES // 2 for _, other in kept):
            continue
        span = slice(first, first + FRAMES)
        traffic = np.concatenate([states[span], parked[span]], 1)
        known = np.concatenate(
            [valid[span], np.ones((FRAMES, len(scene_map.parked)), bool)], 1
        )
        bodies = np.concatenate([size, scene_map.parked_size])
        rows = participants(traffic, known, len(scene_map.parked), ego)
        reason = flaw(traffic[:, rows], known[:, rows], bodies[rows])
        if reason:
            refused[reason] += 1
            continue
        egos.add(ego)
        known = known[:, rows]
        tracks = np.where(known[..., None], traffic[:, rows], 0.0)
        scene_id = f"{scene_map.name}_{first:04d}"
        recording = scene_map.recording(
            scene_id,
            first=first,
            states=tracks,
            valid=known,
            size=bodies[rows],
            ego=0,
        )
        kept.append((recording, first))
    return kept, refused
