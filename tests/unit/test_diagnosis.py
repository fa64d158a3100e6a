"""Each finding of a diagnosis fires where it should, and is quiet where it should."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from scipy.stats import energy_distance, permutation_test
from torch import Tensor, nn

from sbi_rope import CalibrationFinetuner, RoPE
from sbi_rope.diagnosis import Diagnosis, diagnose
from sbi_rope.diagnosis.misspecification import (
    NUM_DRAWS,
    distances,
    mmd_test,
    unmatched,
)
from sbi_rope.diagnosis.prior_shift import (
    COUPLER,
    averaged,
    cross_fit,
    prior_shift,
)
from sbi_rope.metrics.statistics import compare_with_pairs
from sbi_rope.plots import implied_parameters
from tests import gaussian, problems
from tests.stacks import NPE, NUM_PAIRS, PRIOR, QUIET, Box, problem, rope_of, stacked

FINETUNER = CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=150)
QUICK = CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=2)
SHIFTS = {"prior shift: theta_1", "prior shift: theta_2"}
UNLIKE = "batch unlike the calibration pairs"


def conductor(**options: Any) -> RoPE:
    arguments = {"simulator": gaussian.simulator, "finetuner": FINETUNER, **options}
    return RoPE(gaussian.posterior(), **arguments)


@pytest.fixture(scope="module")
def tuned() -> RoPE:
    torch.manual_seed(0)
    rope = conductor().append_calibration(*gaussian.labelled(100))
    return rope.train(seed=0, **QUIET)


def look(rope: RoPE, x_o: Tensor, **options: Any) -> Diagnosis:
    return diagnose(rope, x_o, seed=0, **QUIET, **options)


def alarms(diagnosis: Diagnosis) -> set[str]:
    return {finding.name for finding in diagnosis.alarming}


def flat(diagnosis: Diagnosis) -> str:
    return " ".join(str(diagnosis).split())


def parameters(n: int, *, shifted: bool = False) -> Tensor:
    theta = gaussian.prior().sample((8 * n,))
    return theta[theta[:, 0] > 0.5][:n] if shifted else theta[:n]


def simulations(n: int = 600) -> tuple[Tensor, Tensor]:
    """Parameters, and the posterior means of simulations."""
    theta = gaussian.prior().sample((n,))
    return theta.double(), gaussian.GAIN * gaussian.simulator(theta).double()


@pytest.fixture(scope="module")
def misspecified(tuned: RoPE) -> Diagnosis:
    torch.manual_seed(1)
    return look(tuned, gaussian.real_process(parameters(200)))


def test_nothing_alarms_where_the_simulator_is_right() -> None:
    torch.manual_seed(2)
    diagnosis = look(conductor(), gaussian.simulator(parameters(200)))
    assert alarms(diagnosis) == set()
    # Without calibration pairs, the tests that need labels are left out.
    untested = {one.name for one in diagnosis.findings if one.value is None}
    assert untested == {UNLIKE, "entries far from simulations"}
    assert "against 1000 simulations: no alarm in 4 tests" in flat(diagnosis)


@pytest.mark.medium
def test_misspecification_that_tuning_repairs_is_no_alarm(
    tuned: RoPE, misspecified: Diagnosis
) -> None:
    assert alarms(misspecified) == set()
    assert misspecified["misspecification before tuning"].value < 0.01
    # What the pairs do not show cannot be repaired.
    x_o = gaussian.real_process(parameters(200)) + 0.7
    diagnosis = look(tuned, x_o, num_folds=None)
    assert diagnosis["misspecification after tuning"].alarming


def test_misspecification_without_pairs_alarms_first_and_says_what_to_do() -> None:
    torch.manual_seed(3)
    diagnosis = look(conductor(), gaussian.real_process(parameters(200)))
    assert "misspecification before tuning" in alarms(diagnosis)
    unmatched = diagnosis["observations no simulation matches"]
    assert unmatched.alarming
    assert len(diagnosis.flags) == unmatched.value
    text = flat(diagnosis)
    assert "Without calibration pairs, misspecification looks the same" in text
    assert f"{len(diagnosis.alarming)} alarms in 4 tests" in text
    assert diagnosis.findings[: len(diagnosis.alarming)] == diagnosis.alarming
    for one in diagnosis.findings:
        assert f"{'!' if one.alarming else '-'} {one.name}: {one.sentence}" in text


def test_simulations_are_those_of_the_posterior_with_the_seed(tuned: RoPE) -> None:
    x_o = gaussian.real_process(parameters(60))
    theta = look(tuned, x_o, num_simulations=300, num_folds=None).theta
    coupling = tuned.build_posterior(x_o, num_simulations=300, seed=0).coupling
    noise = gaussian.GAIN * theta - coupling.simulated
    assert noise.std() == pytest.approx(gaussian.GAIN * 0.5, rel=0.1)


def test_a_rope_that_is_not_trained_is_trained_as_a_copy_with_the_seed() -> None:
    torch.manual_seed(39)
    rope = conductor(finetuner=QUICK).append_calibration(*gaussian.labelled(20))
    x_o = gaussian.real_process(parameters(30))
    found = look(rope, x_o, num_simulations=200)
    assert not rope.is_trained
    rope.train(seed=0, **QUIET)
    state = torch.get_rng_state()
    assert found.findings == look(rope, x_o, num_simulations=200).findings
    assert torch.equal(state, torch.get_rng_state())
    assert found["misspecification after tuning"].value is not None


def squared_mmd(a: Tensor, b: Tensor) -> float:
    """By the definition, with the median distance across as bandwidth."""
    width = torch.cdist(a, b).flatten().median()

    def kernel(x: Tensor, y: Tensor) -> Tensor:
        return torch.exp(-((x[:, None] - y[None]) ** 2).sum(dim=2) / (2 * width**2))

    return float(kernel(a, a).mean() + kernel(b, b).mean() - 2 * kernel(a, b).mean())


def test_the_mmd_agrees_with_its_definition(monkeypatch: pytest.MonkeyPatch) -> None:
    torch.manual_seed(10)
    batch, simulated = torch.randn(40, 3).double() + 0.3, torch.randn(120, 3).double()
    # Nothing is shuffled, so that the first 80 simulations are used.
    monkeypatch.setattr(torch, "randperm", torch.arange)
    ratio, p_value = mmd_test(batch, simulated, simulated)
    usual = squared_mmd(simulated[:40], simulated[40:])
    assert ratio == pytest.approx(squared_mmd(batch, simulated[:80]) / usual, rel=1e-6)
    assert p_value == pytest.approx(1 / (1 + NUM_DRAWS) if ratio > 1 else 1.0)


def test_averaged_embeddings_are_those_of_the_gaussian_problem() -> None:
    torch.manual_seed(13)
    theta, embedded = simulations(2000)
    found = averaged(embedded, theta, embedded)
    assert torch.allclose(found, gaussian.GAIN * embedded, atol=0.15)


def test_distances_to_simulations_agree_with_brute_force() -> None:
    torch.manual_seed(14)
    embedded, real = simulations(700)[1], torch.randn(30, 2).double()
    every = torch.cdist(embedded, embedded)
    limit = every.fill_diagonal_(torch.inf).amin(dim=1).max()
    nearest = (real[:, None] - embedded[None]).norm(dim=2).amin(dim=1)
    assert torch.allclose(distances(real, embedded, [embedded]), nearest / limit)


def test_simulations_are_flagged_as_often_as_stated() -> None:
    torch.manual_seed(15)
    counts = 0
    for _ in range(20):
        known, new = simulations(1000)[1], simulations(500)[1]
        counts += int((distances(new, known, [known]) > 1).sum())
    # 20 expected; flags of one set of simulations come together.
    assert 5 <= counts <= 45
    # Of 500 observations, one batch in a hundred has more than four.
    distance = torch.zeros(500)
    assert unmatched(distance, 1000).threshold == 4
    # A single one alarms if it is far away.
    distance[7] = 1.5
    assert not unmatched(distance, 1000).alarming
    distance[7] = 2.5
    assert "Look at 7 before" in unmatched(distance, 1000).sentence


def test_categories_of_a_right_simulator_have_simulations_near_them() -> None:
    torch.manual_seed(38)
    theta = torch.rand(1500, 2).double()
    kind = nn.functional.one_hot(torch.randint(3, (1500,)), 3)
    embedded = torch.cat([theta + 0.1 * torch.randn_like(theta), kind], dim=1)
    moved = averaged(embedded, theta[:1000], embedded[:1000])
    ends, real = [moved[:1000], embedded[:1000]], moved[1000:]
    # Averaging over noise moves observations between the categories.
    assert (distances(real, ends[1], ends[1:]) > 1).double().mean() > 0.9
    assert not unmatched(distances(real, ends[1], ends), 1000).alarming


def test_implied_weights_and_their_distance_agree_with_the_definitions() -> None:
    torch.manual_seed(16)
    # As many simulations as points of comparison: none lies in between.
    (theta, embedded), real = simulations(100), torch.randn(30, 2).double()
    gamma = COUPLER.couple(real, embedded).gamma
    shift = prior_shift(real, theta, [embedded])
    rows = (-torch.cdist(real, embedded) / gamma).softmax(dim=1)
    assert torch.allclose(shift.implied, rows.mean(dim=0), atol=1e-6)
    # Simulations that play the batch do not choose themselves.
    cost = torch.cdist(embedded, embedded).fill_diagonal_(torch.inf)
    rows = (-cost / gamma).softmax(dim=1)
    assert torch.allclose(shift.unshifted, rows.mean(dim=0), atol=1e-6)
    # The distance is that of Kolmogorov and Smirnov.
    for k in range(2):
        order = theta[:, k].argsort()
        gap = (shift.implied - shift.unshifted)[order].cumsum(dim=0).abs().max()
        assert float(shift.distance[k]) == pytest.approx(float(gap), abs=1e-9)


@pytest.mark.medium
def test_a_shifted_batch_alarms_and_a_batch_from_the_prior_does_not() -> None:
    torch.manual_seed(18)
    alarming = torch.zeros(2, 2)
    for _ in range(10):
        theta, embedded = simulations(500)
        for row, shifted in enumerate((False, True)):
            x = gaussian.simulator(parameters(100, shifted=shifted)).double()
            shift = prior_shift(gaussian.GAIN * x, theta, [embedded])
            alarming[row] += shift.distance > shift.threshold
    assert alarming[0].sum() <= 1
    assert alarming[1, 0] == 10


def test_errors_of_g_on_calibration_pairs_raise_the_threshold_of_a_shift() -> None:
    torch.manual_seed(24)
    theta, embedded = simulations(800)
    ends = [averaged(embedded, theta, embedded), embedded]
    best = averaged(gaussian.GAIN * parameters(200).double(), theta, embedded)
    real = gaussian.GAIN**2 * gaussian.simulator(parameters(200)).double()
    # A g that puts everything half a unit too high in one entry.
    wrong = torch.tensor([0.5, 0.0]).double()
    group = torch.arange(200)
    for error, told, expected in (
        (0.0, (best, best, group), [False, False]),
        (wrong, None, [True, False]),
        (wrong, (best + wrong, best, group), [False, False]),
    ):
        shift = prior_shift(real + error, theta, ends, told)
        assert (shift.distance > shift.threshold).tolist() == expected


def two_sample_test(a: Tensor, b: Tensor, groups: Tensor | None = None) -> Any:
    """Test embeddings alone, without estimates."""
    groups = torch.arange(len(a)) if groups is None else groups
    density = SimpleNamespace(
        sample=lambda shape, condition: condition.new_zeros(1, len(condition), 0)
    )
    return compare_with_pairs(a, groups, b, density)


def test_the_p_value_is_that_of_scipy() -> None:
    torch.manual_seed(34)
    a, b = torch.randn(5).double(), torch.randn(6).double() + 1.0
    exact = permutation_test((a, b), energy_distance, alternative="greater")
    found = two_sample_test(a[:, None], b[:, None])
    assert found.p_value == pytest.approx(exact.pvalue, abs=0.04)


def test_pairs_with_the_same_parameters_count_once() -> None:
    torch.manual_seed(36)
    # Six people with ten recordings each, all of them alike.
    people = torch.randn(6, 2).repeat(10, 1) + 1e-3 * torch.randn(60, 2)
    groups, batch = torch.arange(6).repeat(10), torch.randn(50, 2)
    alone = two_sample_test(people[:6], batch).p_value
    found = two_sample_test(people, batch, groups).p_value
    assert found == pytest.approx(alone, abs=0.02)
    assert two_sample_test(people[:4], batch) is None


def test_a_batch_wider_than_the_labels_in_one_parameter_alarms_and_names_it() -> None:
    torch.manual_seed(37)
    labels = parameters(50) * torch.tensor([1.0, 0.2])
    rope = conductor(finetuner=QUICK)
    rope.append_calibration(labels, gaussian.real_process(labels))
    x_o = gaussian.real_process(parameters(200))
    found = look(rope, x_o, num_simulations=200, num_folds=None)[UNLIKE]
    assert found.alarming
    assert "theta_2 (" in found.sentence
    assert "theta_1 (" not in found.sentence


@pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning")
def test_pairs_are_embedded_by_a_g_that_was_not_trained_on_them() -> None:
    torch.manual_seed(23)
    theta, x = gaussian.labelled(6)
    # Another label for the first pair: its own g has not seen it.
    changed = theta.clone()
    changed[0] = -theta[0]
    finetuner = CalibrationFinetuner(learning_rate=1e-2, max_num_epochs=20)
    nets = []
    for labels in (changed, theta):
        rope = conductor(simulator=lambda t: t + 0.0, finetuner=finetuner)
        rope.append_calibration(labels, x)
        torch.manual_seed(0)
        found, targets = cross_fit(rope, 6, show=False)
        nets.append(found)
        assert torch.allclose(targets, gaussian.GAIN * labels.double(), atol=1e-6)
    assert torch.allclose(nets[0][0], nets[1][0], atol=1e-5)
    assert not torch.allclose(nets[0][1:], nets[1][1:], atol=1e-4)


class Learned(Box):
    """A box around the parameters of the pairs tells how they are distributed."""

    learns_prior = True


def drawn(n: int, *, seed: int, centre: float = 0.5) -> tuple[Tensor, Tensor]:
    """Return pairs whose parameters are in a part of the prior."""
    theta = 0.3 * problem(n, seed=seed)[0] + centre
    torch.manual_seed(seed)
    return theta, problems.simulate(theta) + 0.4


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore::sbi_rope.utils.errors.RoPEWarning")
def test_a_shift_is_an_alarm_unless_a_stack_has_learned_it() -> None:
    rope = rope_of(drawn(NUM_PAIRS, seed=1)).train(seed=0, **QUIET)
    stack = stacked(rope, candidates=[PRIOR, NPE, Learned()])
    x_o, options = drawn(60, seed=2)[1], {"num_simulations": 200, "num_folds": None}
    anyone, of_stack = (
        look(rope, x_o, **options),
        look(rope, x_o, posterior=stack, **options),
    )
    assert alarms(anyone) > SHIFTS
    assert alarms(of_stack) == set()
    assert all("This is expected" in of_stack[name].sentence for name in SHIFTS)
    # They are the same numbers, without those about the simulations and the tuned net.
    numbers = {one.name: one.value for one in anyone.findings}
    assert len(of_stack.findings) == len(numbers) - 3
    assert all(one.value == numbers[one.name] for one in of_stack.findings)
    coupled = rope.build_posterior(x_o, num_simulations=100, seed=0)
    of_rope = look(rope, x_o, posterior=coupled, **options)
    assert of_rope.findings == anyone.findings[:-1]
    # The stack expects neither another shift nor one that it could not learn.
    other = drawn(60, seed=2, centre=-0.5)[1]
    assert alarms(look(rope, other, posterior=stack, **options)) == SHIFTS | {UNLIKE}
    report = stack.report
    for change in ({"keeps_prior": True}, {"probability_of_prior": 0.3}):
        stack.report = replace(report, **change)
        assert alarms(look(rope, x_o, posterior=stack, **options)) == SHIFTS


def test_the_picture_shows_the_weights_of_each_parameter(
    misspecified: Diagnosis,
) -> None:
    half = (misspecified.theta[:, 0] > 0).double()
    figure = implied_parameters(replace(misspecified, implied=half))
    assert [axes.get_xlabel() for axes in figure.axes] == ["theta_1", "theta_2"]
    figure.draw_without_rendering()
    outline = figure.axes[0].patches[-1].get_xy()
    assert outline[outline[:, 0] < -0.5, 1].max() == 0.0
    assert outline[outline[:, 0] > 0.0, 1].max() > 0.6
