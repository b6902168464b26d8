"""How a body moves on a smoothed path: over distance, not time, so a creeping or
standing vehicle cannot spin."""

import numpy as np
from scipy.linalg import solveh_banded


def whittaker(values: np.ndarray, penalty: float) -> np.ndarray:
    """Smooth values [T, C] (or [T]): argmin |z - y|^2 + penalty |D3 z|^2 (Whittaker
    1923), D3 the third difference."""
    count = len(values)
    if count < 4:
        return values
    third = np.array([-1.0, 3.0, -3.0, 1.0])
    bands = np.zeros((4, count))  # lower form: bands[k, i] = A[i + k, i]
    for k in range(4):
        for a in range(4 - k):
            bands[k, a : a + count - 3] += third[a] * third[a + k]
    bands *= penalty
    bands[0] += 1.0
    return solveh_banded(bands, values, lower=True)


def tractrix(front: np.ndarray, wheelbase: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses of bodies whose front axles run along `front` while their rear axles follow
    without side slip.

    front [..., P, 2]; wheelbase [...] m -> centres [..., P, 2] midway between the
    axles, unwrapped headings [..., P]. Kinematic bicycle: the rear axle moves along the
    body. While the front axle moves h m straight in direction p, the body's angle d to
    p shrinks as tan(d/2) <- tan(d/2) exp(-h/wheelbase), the tractrix in closed form.
    """
    wheelbase = np.asarray(wheelbase, float)[..., None]
    steps = np.diff(front, axis=-2)
    length = np.linalg.norm(steps, axis=-1)
    along = np.arctan2(steps[..., 1], steps[..., 0])
    shrink = np.exp(-length / wheelbase)
    heading = np.empty(front.shape[:-1])
    heading[..., 0] = along[..., 0]
    for p in range(steps.shape[-2]):
        turn = heading[..., p] - along[..., p]
        aside = 2 * np.arctan(np.tan(turn / 2) * shrink[..., p])
        heading[..., p + 1] = np.where(
            length[..., p] > 0, along[..., p] + aside, heading[..., p]
        )
    heading = np.unwrap(heading, axis=-1)
    return front - wheelbase[..., None] / 2 * np.stack(
        [np.cos(heading), np.sin(heading)], -1
    ), heading
