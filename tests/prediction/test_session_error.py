"""The slow error of an unseen day, against days whose spread is known."""

from __future__ import annotations

import jax
import numpy as np
import pytest

from rfdropo_bayes.posteriors import ParameterInfo, PosteriorRecord, RecordingPrediction
from rfdropo_bayes.prediction.model_error import MODEL_ERROR, ModelError, error_memory, recorded_model_error
from rfdropo_bayes.prediction.predictive import with_session_error
from rfdropo_bayes.prediction.session_error import (
    FREEDOM,
    TIMES,
    SessionError,
    left_out_sentence,
    prior_session_error,
    reach_of,
    session_error,
    session_sentence,
)

TIME = 0.1 * np.arange(100)
LEFT = ModelError(("tip",), (0.003, 0.003, 0.003), 0.5)
PATH = np.stack([0.05 * np.sin(0.3 * TIME), 0.03 * (1.0 - np.cos(0.5 * TIME)), np.full(100, 0.2)], axis=-1)[:, None]
MASK = np.ones((100, 1), dtype=bool)


def predicted(rng, error, draws=400, noise=0.003, name="a"):
    """A recording that a known path misses by an error, and draws that know of the noise alone."""
    observed = PATH + error + noise * rng.normal(size=PATH.shape)
    return RecordingPrediction(
        name, "test", TIME, ("tip",), observed, MASK, PATH + noise * rng.normal(size=(draws, *PATH.shape)), PATH
    )


@pytest.fixture(scope="module")
def prior():
    return prior_session_error(LEFT, [predicted(np.random.default_rng(0), 0.0)])


def slow(prior, rng, times):
    """A constant error of a day, which grows with how far the marker has been."""
    return times * prior.unit(PATH, ["tip"])[:, :, None] * rng.normal(size=(1, 1, 3))


def test_bands_of_unseen_days_hold_what_days_do(prior):
    """Four days left out measure a spread of twice what was left; 300 further days are then in the 90 % bands.

    Of 40 sets of four days the share of days' coordinates held is 0.9 in the mean: its standard error is below 0.015,
    as three axes of one day err each by a constant; the test fails by chance less than once in 1000 seeds.
    """
    rng, inside = np.random.default_rng(1), []
    for number in range(40):
        days = {f"day {k}": [predicted(rng, slow(prior, rng, 2.0))] for k in range(4)}
        found = session_error(prior, days)
        for k in range(8):
            new = predicted(rng, slow(prior, rng, 2.0))
            wide = with_session_error(new, found, jax.random.key(100 * number + k))
            low, high = np.quantile(wide.predicted, [0.05, 0.95], axis=0)
            inside.append(np.mean((new.observed >= low) & (new.observed <= high)))
    assert np.mean(inside) == pytest.approx(0.9, abs=0.05)
    bare = predicted(rng, slow(prior, rng, 2.0))
    low, high = np.quantile(bare.predicted, [0.05, 0.95], axis=0)
    assert np.mean((bare.observed >= low) & (bare.observed <= high)) < 0.8


def test_days_add_to_the_prior_as_a_scaled_inverse_chi_square(prior):
    rng = np.random.default_rng(2)
    days = {f"day {k}": [predicted(rng, slow(prior, rng, 3.0), noise=1e-6)] for k in range(50)}
    found = session_error(prior, days)
    assert found.freedom == FREEDOM + 50
    assert found.times == pytest.approx(3.0, rel=0.25)  # of 50 days of three axes: standard error 6 %
    assert session_error(prior, {}) is prior
    exact = {"a": [predicted(rng, 0.0, noise=1e-9)]}
    assert session_error(prior, exact).times == pytest.approx(TIMES * np.sqrt(FREEDOM / (FREEDOM + 1.0)), rel=1e-3)


def test_errors_of_a_day_are_student_s_t_and_last(prior):
    """The 90 % quantile of |t| with three degrees of freedom is 2.353; of 4000 draws 2 % standard error."""
    unit = np.full((2, 1), 0.001)
    drawn = prior._replace(times=2.0, freedom=3.0, constant=0.5, correlation_time=1.0).draw(
        jax.random.key(0), 4000, np.array([0.0, 1.0]), unit
    )
    assert np.quantile(np.abs(drawn), 0.9) == pytest.approx(2.353 * 0.002, rel=0.08)
    signs = np.sign(drawn[:, 0, 0]) * np.sign(drawn[:, 1, 0])
    correlation = 0.5 + 0.5 * np.exp(-1.0)
    assert signs.mean() == pytest.approx(2.0 / np.pi * np.arcsin(correlation), abs=0.03)


def test_a_day_whose_motion_was_shown_has_no_slow_error(prior):
    far = reach_of(PATH)[-1]
    shown = prior._replace(shown=tuple(far.tolist()))
    assert np.all(shown.unit(PATH, ["tip"]) == 0.0)
    half = prior._replace(shown=tuple((0.6 * far).tolist()))
    assert half.unit(PATH, ["tip"])[-1, 0] == pytest.approx(0.8 * prior.unit(PATH, ["tip"])[-1, 0])
    assert prior.unit(PATH, ["tip"])[0, 0] == 0.0


def test_it_is_read_back_from_plain_values(prior):
    days = {"monday": [predicted(np.random.default_rng(3), 0.002)]}
    found = session_error(prior, days)
    assert SessionError.from_dict(found.as_dict()) == found


def test_the_sentences(prior):
    error = prior._replace(sessions={"monday": 0.0071, "tuesday": 0.016}, covered=0.88)
    assert session_sentence(error) == (
        "No recording of this session was seen. In sessions left out of its fit this model was 7.1 to "
        "16 mm off; its 90 % bands held 88 %."
    )
    assert left_out_sentence(prior) == ""
    assert session_sentence(prior).startswith(
        "No recording of this session was seen. This run left no session out of its fit"
    )


def test_the_lasting_part_of_an_error_is_told_from_one_that_is_forgotten():
    """200 recordings of 100 rows: half of the variance is constant, the rest lasts for five rows, or all of it does.

    Over 50 rows; means of 200 recordings of three axes have a standard error of 4 %.
    """
    rng, memory = np.random.default_rng(5), np.exp(-0.2)
    for constant in (0.5, 0.0):
        found, none = [], np.zeros((100, 1, 3))
        for _ in range(200):
            fast = [rng.normal(size=3)]
            for _ in range(99):
                fast.append(memory * fast[-1] + np.sqrt(1.0 - memory**2) * rng.normal(size=3))
            error = np.sqrt(1.0 - constant) * np.stack(fast) + np.sqrt(constant) * rng.normal(size=3)
            found.append(RecordingPrediction("a", "fit", TIME, ("tip",), error[:, None], MASK, none[None], none))
        lasts = -0.1 / np.log(constant + (1.0 - constant) * memory)
        left = ModelError(("tip",), (1.0, 1.0, 1.0), lasts, step=0.1, memory=error_memory(found, 0.1))
        assert left.constant(5.0) == pytest.approx(constant, abs=0.06)
        correlation = left.lasting(0.1, 50).autocorrelation
        assert correlation[-1] == pytest.approx(constant, abs=0.06)
        assert LEFT.lasting(0.1, 50).order == 1


def test_an_earlier_posterior_of_recordings_of_two_rates_says_how_long_errors_last():
    """Half of the rows are 10 ms apart and half 20 ms: none are 15 ms apart, their median."""
    rng, found = np.random.default_rng(0), []
    for name, step in (("fast", 0.01), ("slow", 0.02)):
        error = np.cumsum(1e-4 * rng.normal(size=(101, 1, 3)), axis=0)
        time, mask = step * np.arange(101), np.ones((101, 1), bool)
        found.append(RecordingPrediction(name, "fit", time, ("tip",), error, mask, np.zeros((2, 101, 1, 3))))
    info = ParameterInfo("young_modulus", "Pa", 1e6, 5e7)
    earlier = {MODEL_ERROR: {"markers": ["tip"], "scale": [1e-3, 1e-3, 1e-3], "correlation_time": 1.0}}
    record = PosteriorRecord((info,), {"young_modulus": np.full((1, 2), 4e6)}, {}, tuple(found), attrs=earlier)
    left = recorded_model_error(record)
    assert left is not None
    assert left.step == pytest.approx(0.01)
    assert left.memory[0] == 1.0
    assert left.memory[1] > 0.9


def test_an_error_that_the_draws_expect_is_none_of_the_day_s(prior):
    """Draws two centimetres to either side, and a day that lies on one of them."""
    aside = np.full_like(PATH, 0.02)
    day = RecordingPrediction(
        "a", "test", TIME, ("tip",), PATH + aside, MASK, np.stack([PATH + aside, PATH - aside]), PATH
    )
    assert session_error(prior, {"day": [day]}).times == pytest.approx(TIMES * np.sqrt(FREEDOM / (FREEDOM + 1)))
