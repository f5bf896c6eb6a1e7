"""Image losses in float64 NumPy and SciPy, as the papers write them; beyond the image everything is 0."""

import numpy as np
from scipy.ndimage import correlate1d


def l1(image, target, mask):
    return (mask[..., None] * np.abs(image - target)).sum() / image.size


def similarity(image, target):
    """Structural similarity of every window (Wang et al. 2004, Eq. 13), (H, W, C)."""
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window /= window.sum()

    def mean(values):
        down = correlate1d(values, window, axis=0, mode="constant")
        return correlate1d(down, window, axis=1, mode="constant")

    x, y = mean(image), mean(target)
    var_x, var_y, cov = mean(image**2) - x**2, mean(target**2) - y**2, mean(image * target) - x * y
    c1, c2 = 0.01**2, 0.03**2
    return (2.0 * x * y + c1) * (2.0 * cov + c2) / ((x**2 + y**2 + c1) * (var_x + var_y + c2))


def ssim(image, target, mask):
    return (mask[..., None] * (1.0 - similarity(image, target))).sum() / image.size


def normal(rendered, expected, mask, tolerance=np.inf):
    length = np.linalg.norm(rendered, axis=-1)
    counted = (length > 1e-3) & (np.abs(expected).max(axis=-1) > 0.0)
    cosine = (rendered * expected).sum(axis=-1) / np.where(counted, length, 1.0)
    chord = 2.0 * (1.0 - cosine)
    term = 0.5 * chord if np.isinf(tolerance) else tolerance * (np.sqrt(tolerance**2 + chord) - tolerance)
    return (mask * np.where(counted, term, 0.0)).sum() / mask.size


def slope(loss, array, step=1e-5):
    """Central differences of ``loss(array)`` with respect to every element."""
    found = np.empty(array.shape)
    for i in np.ndindex(*array.shape):
        moved = np.zeros(array.shape)
        moved[i] = step
        found[i] = (loss(array + moved) - loss(array - moved)) / (2.0 * step)
    return found
