"""How strong an effect is: of unknown order of magnitude.

A Gaussian prior as wide as the strongest effect makes a small one pay for every order of magnitude that it is smaller,
and effects of different units pay differently for the same thing. So each effect's prior is a mixture of Gaussians
whose widths are spread evenly in their logarithm. Fits are made under the widest; the others follow from its posterior.

One effect alone may be too weak for the recording to show: so much is left of its prior where nothing is seen, and the
simulation as it is is as much less certain. Of several each is one that the recording can show; with a weaker one among
them they are the smaller combination. So each Gaussian is multiplied there by the square of the strength, which leaves
nothing at zero (the moment prior of Johnson and Rossell 2010): what is not needed counts far less than what is. And
they have that share of the prior which the one has alone that is shown best: with another one beside it, an effect is
not the likelier for what it could have been without being seen.
"""

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.special import log_ndtr

from .._normal import log_density
from ._evidence import cut_off
from ._mixture import over_choices, over_widest
from ._squares import log_product_of_squares

# Widths of the mixture, and the narrowest of them in standard deviations of the estimate.
WIDTHS, SEEN = 7, 4.0
# The widths of an effect alone, and the narrowest of them in that of the widest: as the weakest missing force is to the
# strongest that are tried.
FAINT_WIDTHS, FAINT = 13, 1e-4
# What the recording says of a direction is at least this share of what the prior says.
_SILENT = 1e-9
# Widths by the narrowest: evenly spread in their logarithm.
_SHRINKING, _FAINT_ONES = np.linspace(1.0, 0.0, WIDTHS), np.geomspace(FAINT, 1.0, FAINT_WIDTHS)
# Of a correlation matrix.
_ROUND_OFF = 1e-13
# Entries of one effect from which on matrices are not inverted: the starts of an unseen oscillator in many recordings.
_MANY = 16


def mixture_gain(
    centre: Float[np.ndarray, " a"], spread: Float[np.ndarray, "a a"], own: np.ndarray, lowest: Float[np.ndarray, " a"],
    alone: bool = False,
) -> float:  # fmt: skip
    """Log evidence under unknown orders of magnitude, less that under the widest priors: for a posterior in units of
    these, all of them about zero and of sd one.

    **Arguments:** - `own`: the number of the effect that each entry belongs to. - `lowest`: bounds of the entries. -
    `alone`: whether an effect too weak to be seen counts.
    """
    return float(mixture_gains(centre[None], spread[None], own, lowest, alone)[0])


@np.errstate(all="ignore")  # a spread that round-off left without meaning gains nothing
def mixture_gains(
    centre: Float[np.ndarray, "lane a"], spread: Float[np.ndarray, "lane a a"], own: np.ndarray,
    lowest: Float[np.ndarray, " a"], alone: bool = False,
) -> Float[np.ndarray, " lane"]:  # fmt: skip
    """The same for many posteriors of like effects at once."""
    a, effects = centre.shape[1], int(own[-1]) + 1
    sound = np.isfinite(centre).all(1) & np.isfinite(spread).all((1, 2)) & (_diagonal(spread) > 0).all(1)
    spread = np.where(sound[:, None, None], spread, 0.5 * np.eye(a))
    values, vectors = np.linalg.eigh(spread)
    left = np.maximum(1.0 - values, _SILENT)  # what the recording says, as a share of all that is known
    bare = np.maximum(values, 1e-300) / left  # of the covariance without the priors
    along = np.einsum("lij,li->lj", vectors, np.where(sound[:, None], centre, 0.0))
    if effects == 1 and a > _MANY:
        widths = np.concatenate([_shares(values, alone), np.ones((len(centre), 1))], axis=1)
        return _sound(over_widest(_log_weights_of_one(vectors, bare, along / left, widths, lowest, alone)), sound)
    likelihood = (vectors * bare[:, None]) @ vectors.mT
    told = np.einsum("lij,lj->li", vectors, along / left)
    parts = [_eigenvalues(spread[:, own == k][:, :, own == k]) for k in range(effects)]
    shares = np.stack([_shares(part, alone) for part in parts], axis=1)

    def weighed(choices: Int[np.ndarray, "_ choice effect"]) -> Float[np.ndarray, "lane weighed"]:
        widths = shares[np.arange(len(choices))[:, None, None], np.arange(effects), choices][..., own]
        # The widest priors last, whose effects may be too weak to be seen.
        every = np.concatenate([widths, np.ones((len(centre), 1, a))], axis=1)
        return _log_weights(told, likelihood, every, lowest, own, alone)

    return _sound(over_choices(weighed, shares, centre, own), sound)


def _sound(gains: Float[np.ndarray, " lane"], sound: Bool[np.ndarray, " lane"]) -> Float[np.ndarray, " lane"]:
    return np.where(sound & np.isfinite(gains), gains, 0.0)


def _eigenvalues(matrices: Float[np.ndarray, "lane b b"]) -> Float[np.ndarray, "lane b"]:
    return matrices[:, 0] if matrices.shape[-1] == 1 else np.linalg.eigvalsh(matrices)


def _shares(values: Float[np.ndarray, "lane b"], alone: bool) -> Float[np.ndarray, "lane width"]:
    """Widths of one effect's prior, in that of the widest, by the eigenvalues of what is known of it."""
    values = np.clip(values, 1e-300, None)
    information = np.mean(np.maximum(1.0 / values - 1.0, 0.0), axis=-1)
    return widths_from(SEEN / np.sqrt(np.maximum(information, 1e-300)), alone)


def faint_share(sd: float) -> float:
    """Share of the prior of an effect alone that an estimate with this error, in units of the widest, does not show."""
    return float(np.clip(np.log(SEEN * max(sd, 1e-300) / FAINT) / -np.log(FAINT), 0.0, 1.0))


def widths_from(narrowest: Float[np.ndarray, "*lane"], alone: bool) -> Float[np.ndarray, "*lane width"]:
    """Widths of an effect's prior in that of the widest, the narrowest given; all of them the widest where nothing is
    seen of any."""
    if alone:
        return np.broadcast_to(_FAINT_ONES, (*np.shape(narrowest), FAINT_WIDTHS))
    return np.clip(narrowest, 1e-12, 1.0)[..., None] ** _SHRINKING


def _diagonal(matrices: Float[np.ndarray, "*lane a a"]) -> Float[np.ndarray, "*lane a"]:
    return np.diagonal(matrices, axis1=-2, axis2=-1)


def _log_weights(
    told: Float[np.ndarray, "lane a"], likelihood: Float[np.ndarray, "lane a a"],
    widths: Float[np.ndarray, "lane choice a"], lowest: Float[np.ndarray, " a"], own: Int[np.ndarray, " a"],
    alone: bool,
) -> Float[np.ndarray, "lane choice"]:  # fmt: skip
    """Log evidence of every choice of widths, up to one constant; of several with the mean of their squares' product,
    save the widest, the last."""
    prior = widths**2
    total = likelihood[:, None] + prior[..., None] * np.eye(told.shape[-1])
    scale = np.sqrt(_diagonal(total))
    scales = scale[..., :, None] * scale[..., None, :]
    correlation = total / scales + _ROUND_OFF * np.eye(told.shape[-1])  # which two like unknowns may leave singular
    inverse = np.linalg.inv(correlation) / scales
    solved = np.einsum("lcij,lj->lci", inverse, told)
    out = -0.5 * np.einsum("lci,li->lc", solved, told) - 0.5 * np.linalg.slogdet(correlation)[1]
    out -= np.log(scale).sum(-1)
    some = np.isfinite(lowest)
    centre, covariance = prior * solved, prior[..., None] * (inverse @ likelihood[:, None])
    if some.any():
        mass, centre, covariance = cut_off(centre - np.where(some, lowest, 0.0), covariance, some)
        centre = centre + np.where(some, lowest, 0.0)
        out += mass - log_ndtr(-lowest[some] / widths[..., some]).sum(-1)
    if not alone:
        unit = np.sqrt(_prior_squares(widths, lowest) * np.bincount(own)[own])
        scaled = covariance / (unit[..., :, None] * unit[..., None, :])
        out[:, :-1] += log_product_of_squares(centre / unit, scaled, own)[:, :-1]
    return out


def _log_weights_of_one(
    vectors: Float[np.ndarray, "lane a a"], values: Float[np.ndarray, "lane a"], told: Float[np.ndarray, "lane a"],
    widths: Float[np.ndarray, "lane choice"], lowest: Float[np.ndarray, " a"], alone: bool,
) -> Float[np.ndarray, "lane choice"]:  # fmt: skip
    """The same where all entries are one effect's, of one width: in the axes of the likelihood's covariance, for which
    no matrix is inverted. `told` is along these."""
    prior = widths[..., None] ** 2
    total = values[:, None] + prior
    out = -0.5 * (told[:, None] ** 2 / total + np.log(total)).sum(-1)
    centre = np.einsum("lij,lcj->lci", vectors, prior * told[:, None] / total)
    along, some = prior * values[:, None] / total, np.isfinite(lowest)
    variance = np.einsum("lij,lcj->lci", vectors**2, along)
    if some.any():
        beside = np.einsum("lij,lcj,lkj->lcik", vectors, along, vectors[:, some])  # every entry with those
        before = beside[..., some, :]
        mass, moved, after = cut_off(centre[..., some] - lowest[some], before, np.ones(int(some.sum()), bool))
        follow = beside @ np.linalg.inv(before)
        variance -= np.einsum("lcik,lckm,lcim->lci", follow, before - after, follow)
        centre = centre + np.einsum("lcik,lck->lci", follow, moved + lowest[some] - centre[..., some])
        out += mass - log_ndtr(-lowest[some] / widths[..., None]).sum(-1)
    if not alone:
        whole = _prior_squares(np.broadcast_to(widths[..., None], centre.shape), lowest)
        out[:, :-1] += np.log(((centre**2 + variance) / whole).mean(-1))[:, :-1]
    return out


def _prior_squares(widths: Float[np.ndarray, "lane choice a"], lowest: Float[np.ndarray, " a"]) -> np.ndarray:
    """Mean squares of the priors, which are cut off below a bound."""
    below = lowest / widths
    far = below > -30.0  # further down nothing is cut off
    edge = np.where(far, np.exp(log_density(np.where(far, below, 0.0)) - log_ndtr(-np.where(far, below, 0.0))), 0.0)
    return widths**2 * (1.0 + np.where(far, below, 0.0) * edge)
