"""Posteriors with known answers, as problems for the inference methods."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import multivariate_normal, norm

from rfdropo_bayes.bayes.problem import ProblemDefaults, RolloutDefaults


def plain(value):
    """A NumPy array unless JAX traces: each of JAX's operations on an array of another shape would be compiled."""
    return value if isinstance(value, jax.core.Tracer) else np.asarray(value)


def kind(*values):
    """JAX where it traces, NumPy elsewhere."""
    return jnp if any(isinstance(value, jax.core.Tracer) for value in values) else np


def normal_density(value, mean, sd):
    """Log density of a normal."""
    return -0.5 * ((value - mean) / sd) ** 2 - np.log(np.sqrt(2.0 * np.pi) * sd)


def sigmoid(u):
    """Between 0 and 1."""
    u = plain(u)
    return 0.5 + 0.5 * kind(u).tanh(0.5 * u)


def log_sigmoids(u):
    """Log density of logits whose sigmoids are uniform, summed over the last axis."""
    u = abs(plain(u))
    return -(u + 2.0 * kind(u).log1p(kind(u).exp(-u))).sum(axis=1)


def together(values, names):
    """The values of some names along a last axis."""
    parts = [plain(values[name]) for name in names]
    return kind(*parts).stack(parts, axis=-1)


class LinearGaussian(ProblemDefaults):
    """y = A x + noise with a Gaussian prior on x: posterior and evidence of every prefix in closed form.

    Nothing in it is symmetric or centred: rows differ in size, the prior mean is not zero, a row has its own noise.
    """

    def __init__(self, n_rows: int = 12, d: int = 3, seed: int = 0, noise: float = 0.3) -> None:
        rng = np.random.default_rng(seed)
        self.design = rng.normal(size=(n_rows, d)) * np.linspace(0.5, 2.0, n_rows)[:, None]
        self.mean = rng.normal(size=d)
        self.sd = rng.uniform(0.5, 2.0, d)
        self.noise = noise * np.linspace(1.0, 2.0, n_rows)
        truth = self.mean + 1.3 * self.sd * rng.normal(size=d)
        self.data = self.design @ truth + self.noise * rng.normal(size=n_rows)
        self.names = tuple(f"x{j}" for j in range(d))
        self.units = dict.fromkeys(self.names, "1")
        self.bounds = dict.fromkeys(self.names, (-np.inf, np.inf))
        self.n_rows = n_rows
        self.calls: list[tuple[int, int]] = []

    def sample_prior(self, key, n):
        z = plain(jax.random.normal(key, (n, len(self.names))))
        return self.from_unconstrained(self.mean + self.sd * z)

    def to_unconstrained(self, values):
        return together(values, self.names)

    def from_unconstrained(self, u):
        return {name: plain(u)[:, j] for j, name in enumerate(self.names)}

    def log_prior(self, u):
        return normal_density(plain(u), self.mean, self.sd).sum(axis=1)

    def _row_density(self, u, horizon):
        return normal_density(self.data[:horizon], u @ self.design[:horizon].T, self.noise[:horizon])

    def row_log_likelihood(self, values, horizon):
        u = self.to_unconstrained(values)
        self.calls.append((len(u), horizon))
        return self._row_density(u, horizon), np.zeros(len(u), dtype=int)

    def residuals(self, values, horizon):
        return (self.data[:horizon] - together(values, self.names) @ self.design[:horizon].T) / self.noise[:horizon]

    def prefix_log_evidence(self):
        """log p(y[:h]) for h = 1 ... n_rows."""
        covariance = np.diag(self.noise**2) + (self.design * self.sd**2) @ self.design.T
        mean = self.design @ self.mean
        return np.array(
            [multivariate_normal.logpdf(self.data[:h], mean[:h], covariance[:h, :h]) for h in range(1, self.n_rows + 1)]
        )

    def posterior(self):
        """Mean and covariance given all rows."""
        precision = np.diag(self.sd**-2.0) + (self.design.T * self.noise**-2.0) @ self.design
        covariance = np.linalg.inv(precision)
        mean = covariance @ (self.mean / self.sd**2 + self.design.T @ (self.data / self.noise**2))
        return mean, covariance


class Decay(ProblemDefaults):
    """y = amplitude exp(-rate t) + noise of unknown deviation; log-normal parameters.

    Nonlinear, with a noise parameter.

    ``fails_above``: rollouts with a higher rate fail with status 1, and their likelihood is left as NaN.
    """

    names = ("amplitude", "rate", "noise")
    units = {"amplitude": "m", "rate": "1/s", "noise": "m"}  # noqa: RUF012
    bounds = dict.fromkeys(names, (0.0, np.inf))
    status_names = {1: "diverged"}  # noqa: RUF012

    def __init__(self, n_rows: int = 60, seed: int = 0, fails_above: float = np.inf) -> None:
        self.n_rows, self.fails_above = n_rows, fails_above
        self.time = np.linspace(0.0, 3.0, n_rows)
        self.centre = np.log([1.0, 1.0, 0.1])
        self.spread = np.array([0.7, 0.7, 1.0])
        self.truth = {"amplitude": 1.4, "rate": 0.8, "noise": 0.05}
        rng = np.random.default_rng(seed)
        clean = self.truth["amplitude"] * np.exp(-self.truth["rate"] * self.time)
        self.data = clean + self.truth["noise"] * rng.normal(size=n_rows)

    def sample_prior(self, key, n):
        return self.from_unconstrained(self.centre + self.spread * plain(jax.random.normal(key, (n, 3))))

    def to_unconstrained(self, values):
        positive = together(values, self.names)
        return kind(positive).log(positive)

    def from_unconstrained(self, u):
        values = kind(u).exp(plain(u))
        return {name: values[:, j] for j, name in enumerate(self.names)}

    def log_prior(self, u):
        return normal_density(plain(u), self.centre, self.spread).sum(axis=1)

    def row_log_likelihood(self, values, horizon):
        amplitude, rate, noise = (np.asarray(values[name])[:, None] for name in self.names)
        rows = normal_density(self.data[:horizon], amplitude * np.exp(-rate * self.time[:horizon]), noise)
        failed = np.asarray(values["rate"]) > self.fails_above
        rows[failed] = np.nan
        return rows, failed.astype(int)

    def residuals(self, values, horizon):
        amplitude, rate, noise = (np.asarray(values[name])[:, None] for name in self.names)
        return (self.data[:horizon] - amplitude * np.exp(-rate * self.time[:horizon])) / noise


class Touched(LinearGaussian):
    """y = x0 in the first half of the rows, y = x0 + x1^3 - 3 x1 later: a body that is touched halfway.

    Least squares that begin at x1 = 0, its prior's middle, end at x1 = -1; the truth is 2.2.
    """

    def __init__(self, n_rows: int = 20) -> None:
        super().__init__(n_rows=n_rows, d=2)
        self.mean, self.sd, self.noise = np.zeros(2), np.full(2, 1.5), np.full(n_rows, 0.1)
        self.later = (np.arange(n_rows) >= n_rows // 2).astype(float)
        self.data = np.asarray(self.fit(np.array([0.7, 2.2]), n_rows))

    def fit(self, u, horizon):
        return u[..., :1] + (u[..., 1:] ** 3 - 3.0 * u[..., 1:]) * self.later[:horizon]

    def _row_density(self, u, horizon):
        return normal_density(self.data[:horizon], self.fit(u, horizon), self.noise[:horizon])

    def residuals(self, values, horizon):
        return (self.data[:horizon] - self.fit(together(values, self.names), horizon)) / self.noise[:horizon]


class TwoModes(LinearGaussian):
    """One row y = |x| + noise in ``d`` dimensions (the rest observed directly): two modes of unequal prior mass."""

    def __init__(self, d: int = 3) -> None:
        super().__init__(n_rows=d, d=d)
        self.design, self.noise = np.eye(d), np.full(d, 0.1)
        self.mean, self.sd = np.full(d, 0.25), np.ones(d)
        self.data = np.concatenate([[1.0], np.linspace(-0.5, 0.5, d - 1)])

    def _row_density(self, u, horizon):
        fit = kind(u).concatenate([abs(u[:, :1]), u[:, 1:]], axis=1)[:, :horizon]
        return normal_density(self.data[:horizon], fit, self.noise[:horizon])

    def residuals(self, values, horizon):
        u = together({**values, "x0": abs(values["x0"])}, self.names)
        return (self.data[:horizon] - u[:, :horizon]) / self.noise[:horizon]

    def mode_evidence(self):
        """Log evidence of the modes x > 0 and x < 0 of the first row, together and their shares."""
        sd = np.hypot(self.sd, self.noise)
        plus, minus = (norm.logpdf(sign * self.data[0], self.mean[0], sd[0]) for sign in (1.0, -1.0))
        rest = norm.logpdf(self.data[1:], self.mean[1:], sd[1:]).sum()
        return float(np.logaddexp(plus, minus) + rest), float(1.0 / (1.0 + np.exp(minus - plus)))


class Ratio(LinearGaussian):
    """Data see the ratio of a stiffness and a mass only, by default to 0.02 %; both priors are uniform, and end on the
    ridge."""

    low, high = np.array([2.0, 0.005]), np.array([7.0, 1.0])

    def __init__(self, truth: tuple[float, float] = (3.0, 0.9), noise: float = 2e-3) -> None:
        super().__init__(n_rows=40, d=2)
        self.names = ("stiffness", "mass")
        self.units = dict.fromkeys(self.names, "1")
        self.bounds = {"stiffness": (2.0, 7.0), "mass": (0.005, 1.0)}
        self.gain, self.noise = np.linspace(0.5, 2.0, 40), np.full(40, noise)
        rng = np.random.default_rng(3)
        self.data = self.gain * np.log(truth[0] / truth[1]) + self.noise * rng.normal(size=40)

    def sample_prior(self, key, n):
        share = plain(jax.random.uniform(key, (n, 2)))
        return dict(zip(self.names, (self.low + (self.high - self.low) * share).T, strict=True))

    def to_unconstrained(self, values):
        x = together(values, self.names)
        with np.errstate(divide="ignore", invalid="ignore"):  # at a bound and beyond it there is no coordinate
            return kind(x).log((x - self.low) / (self.high - x))

    def from_unconstrained(self, u):
        x = self.low + (self.high - self.low) * sigmoid(u)
        return {name: x[:, j] for j, name in enumerate(self.names)}

    def log_prior(self, u):
        return log_sigmoids(u)

    def _row_density(self, u, horizon):
        values = self.from_unconstrained(u)
        fit = kind(u).log(values["stiffness"] / values["mass"])[:, None] * self.gain[:horizon]
        return normal_density(self.data[:horizon], fit, self.noise[:horizon])

    def residuals(self, values, horizon):
        fit = np.log(values["stiffness"] / values["mass"])[:, None] * self.gain[:horizon]
        return (self.data[:horizon] - fit) / self.noise[:horizon]

    def along_the_ridge(self, mass):
        """Distribution function of the mass given all rows, at given masses, and the log evidence.

        Given the ratio c the prior's density on the ridge goes with the mass, from the end of one range to that of the
        other; the ratio is known so well that c is a number.
        """
        weight = self.gain / self.noise**2
        log_ratio, information = weight @ self.data / (weight @ self.gain), weight @ self.gain
        ratio = np.exp(log_ratio)
        ends = np.array([max(0.005, 2.0 / ratio), min(1.0, 7.0 / ratio)])
        best = norm.logpdf(self.data, self.gain * log_ratio, self.noise).sum()
        area = 0.5 * ratio * (ends[1] ** 2 - ends[0] ** 2) / np.prod(self.high - self.low)
        evidence = best + 0.5 * np.log(2.0 * np.pi / information) + np.log(area)
        return (mass**2 - ends[0] ** 2) / (ends[1] ** 2 - ends[0] ** 2), float(evidence)


class Washboard(LinearGaussian):
    """A valley with a ripple of 20 nats across it: optimisations end at the nearest of thousands of local maxima, and
    the highest holds the posterior. Each row has an equal share.
    """

    width, ripple = 0.25, 10.0

    def __init__(self, d: int = 4) -> None:
        super().__init__(n_rows=8, d=d)
        self.mean, self.sd, self.centre = np.full(d, 2.0), np.full(d, 3.0), np.linspace(-1.3, 3.4, d)

    def _shape(self, away):
        return -0.5 * (away / self.width) ** 2 - self.ripple * (1.0 - kind(away).cos(2.0 * np.pi * away))

    def _row_density(self, u, horizon):
        whole = self._shape(u - self.centre).sum(axis=1)
        return kind(whole).tile(whole[:, None] / self.n_rows, (1, horizon))

    def residuals(self, values, horizon):
        away = np.asarray(together(values, self.names)) - self.centre
        parts = [away / self.width, 2.0 * np.sqrt(self.ripple) * np.sin(np.pi * away)]
        return np.sqrt(horizon / self.n_rows) * np.concatenate(parts, axis=1)

    def log_evidence(self):
        away = np.linspace(-4.0, 4.0, 80001)
        shape = np.exp(self._shape(away))
        return sum(np.log(np.trapezoid(shape * norm.pdf(c + away, 2.0, 3.0), away)) for c in self.centre)


class Spring(RolloutDefaults):
    """Features of a damped oscillation whose frequency and damping differ from rollout to rollout, for RF-DROPO."""

    names = ("frequency", "damping", "noise")
    physical_names = ("frequency", "damping")
    units = {"frequency": "1/s", "damping": "1/s", "noise": "m"}  # noqa: RUF012
    bounds = {"frequency": (1.0, 5.0), "damping": (0.0, 2.0), "noise": (0.0, 1.0)}  # noqa: RUF012

    def __init__(self, n_rows: int = 40, truth: tuple[float, float] = (2.3, 0.4)) -> None:
        self.n_rows = n_rows
        self.time = np.linspace(0.0, 3.0, n_rows)
        self.calls: list[tuple[int, int]] = []
        self.observed = self._features(np.array([truth[0]]), np.array([truth[1]]))[0]
        self.observed_mask = np.ones_like(self.observed, dtype=bool)

    def _features(self, frequency, damping):
        angle = frequency[:, None] * self.time
        decay = np.exp(-damping[:, None] * self.time)
        return 0.05 * np.stack([decay * np.cos(angle), decay * np.sin(angle)], axis=-1)

    def rollouts(self, values, horizon):
        features = self._features(np.asarray(values["frequency"]), np.asarray(values["damping"]))
        self.calls.append((len(features), horizon))
        return features[:, :horizon], np.zeros(len(features), dtype=int)

    def sample_prior(self, key, n):
        keys = jax.random.split(key, 3)
        shares = [plain(jax.random.uniform(k, (n,))) for k in keys]
        return self._within(dict(zip(self.names, shares, strict=True)))

    def _within(self, shares):
        """Values at shares of the way between their bounds."""
        return {name: self.bounds[name][0] + np.ptp(self.bounds[name]) * share for name, share in shares.items()}

    def to_unconstrained(self, values):
        x, (low, high) = together(values, self.names), np.array([self.bounds[name] for name in self.names]).T
        return kind(x).log((x - low) / (high - x))

    def from_unconstrained(self, u):
        return self._within({name: sigmoid(u)[:, j] for j, name in enumerate(self.names)})

    def log_prior(self, u):
        return log_sigmoids(u)

    def row_log_likelihood(self, values, horizon):
        features, status = self.rollouts(values, horizon)
        noise = np.asarray(values["noise"])[:, None, None]
        return norm.logpdf(self.observed[:horizon], features, noise).sum(axis=2), status
