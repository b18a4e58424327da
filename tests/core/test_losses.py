"""Losses and metrics in closed form, on small tensors."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from lalaloc_core.learn.metrics import Accuracy, chamfer_distance
from lalaloc_core.learn.training import losses
from lalaloc_core.nets.image_features import WallModes
from tests.strategies import present, seeds


def distances(seed: int, anchors: int = 3, neighbours: int = 6) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed % 2**31)
    return tuple(torch.empty(anchors, neighbours).uniform_(0.1, 2.0, generator=generator) for _ in range(2))  # type: ignore[return-value]


def walls(log_profile: torch.Tensor, log_scale: float) -> WallModes:
    """Return walls of one mode each."""
    return WallModes(
        *(value[..., None] for value in (log_profile, torch.full_like(log_profile, log_scale), 0.0 * log_profile))
    )


class TestLogRatio:
    @pytest.mark.parametrize("all_pairs", [True, False])
    @given(seed=seeds(), scale=st.floats(0.05, 5.0))
    def test_proportional_distances_have_zero_loss(self, all_pairs: bool, seed: int, scale: float) -> None:
        chamfer, _ = distances(seed)
        assert losses.log_ratio(scale * chamfer, chamfer, 2, all_pairs=all_pairs).item() < 1e-5

    @pytest.mark.parametrize("all_pairs", [True, False])
    @given(seed=seeds(), scale=st.floats(0.5, 5.0))
    def test_loss_is_invariant_to_scale(self, all_pairs: bool, seed: int, scale: float) -> None:
        latent, chamfer = distances(seed)
        expected = losses.log_ratio(latent, chamfer, 2, all_pairs=all_pairs)
        for scaled in ((scale * latent, chamfer), (latent, scale * chamfer)):
            loss = losses.log_ratio(*scaled, 2, all_pairs=all_pairs)
            torch.testing.assert_close(loss, expected, rtol=1e-3, atol=1e-4)

    def test_positives_are_compared_with_negatives(self) -> None:
        latent = torch.tensor([[0.5, 1.0, 2.0]])
        chamfer = torch.tensor([[0.5, 2.0, 1.0]])
        # Pairs (0, 1) and (0, 2): log(D0/Dj) - log(Ch0/Chj) = ±log 2.
        expected = math.log(2.0) ** 2
        assert losses.log_ratio(latent, chamfer, 1, all_pairs=False).item() == pytest.approx(expected, rel=1e-4)

    def test_all_pairs_compares_negatives_with_each_other(self) -> None:
        latent, chamfer = torch.tensor([[1.0, 1.0, 2.0]]), torch.tensor([[1.0, 1.0, 1.0]])
        # 4 of the 9 ordered pairs include the last neighbour and differ by log 2.
        expected = 4.0 / 9.0 * math.log(2.0) ** 2
        assert losses.log_ratio(latent, chamfer, 2, all_pairs=True).item() == pytest.approx(expected, rel=1e-4)
        order = torch.tensor([2, 0, 1])
        shuffled = losses.log_ratio(latent[:, order], chamfer[:, order], 1, all_pairs=True)
        assert shuffled.item() == pytest.approx(expected, rel=1e-4)

    def test_coinciding_latents_have_finite_gradients(self) -> None:
        latent = torch.zeros(1, 3, requires_grad=True)
        loss = losses.log_ratio(latent, torch.ones(1, 3), 1, all_pairs=True)
        (loss + losses.log_ratio(latent, torch.tensor([[1.0, 0.0, 2.0]]), 1, all_pairs=False)).backward()
        assert bool(torch.isfinite(present(latent.grad)).all())

    def test_gradient_pushes_close_neighbours_away(self) -> None:
        latent = torch.tensor([[1.0, 1.0]], requires_grad=True)
        losses.log_ratio(latent, torch.tensor([[1.0, 3.0]]), 1, all_pairs=False).backward()
        assert present(latent.grad)[0, 1] < 0.0 < present(latent.grad)[0, 0]


class TestOthers:
    def test_scale_loss_fixes_latent_distance_per_metre(self) -> None:
        _, chamfer = distances(0)
        assert losses.distance_scale(0.5 * chamfer, chamfer, 0.5).item() < 1e-6
        assert losses.distance_scale(chamfer, chamfer, 0.5).item() == pytest.approx(math.log(2.0) ** 2, rel=1e-3)
        assert losses.distance_scale(0.25 * chamfer, chamfer, 0.5).item() == pytest.approx(math.log(2.0) ** 2, rel=1e-3)

    def test_decode_is_the_mean_absolute_error_and_l2_is_not_squared(self) -> None:
        decoded = torch.tensor([[[1.0, 2.0], [3.0, 4.0]]])
        assert losses.decode(decoded, decoded + torch.tensor([[[1.0, -1.0], [0.0, 2.0]]])).item() == 1.0
        first = torch.tensor([[3.0, 0.0], [0.0, 0.0]])
        assert losses.l2(first, torch.tensor([[0.0, 4.0], [0.0, 1.0]])).item() == 3.0

    def test_ring_distillation_is_normalised_by_channel(self) -> None:
        teacher = torch.randn(8, 3, 16, generator=torch.Generator().manual_seed(0))
        student = teacher + teacher.std(dim=(0, 2), keepdim=True) * torch.tensor([0.5, 1.0, 1.5])[None, :, None]
        assert losses.ring_distillation(student, teacher).item() == pytest.approx(1.0, rel=1e-4)
        stretch = torch.tensor([1.0, 10.0, 100.0])[None, :, None]
        assert losses.ring_distillation(student * stretch, teacher * stretch).item() == pytest.approx(1.0, rel=1e-4)

    @given(st.floats(-3.0, 1.0))
    def test_laplace_loss_is_minimal_at_the_truth(self, log_error: float) -> None:
        profile = torch.full((1, 4), 3.0)
        error = math.exp(log_error)
        log_profile = torch.log(profile) + error

        def loss(log_scale: float, shift: float = 0.0) -> float:
            return losses.laplace_mixture(walls(log_profile + shift, log_scale), profile.log()).item()

        # The loss is minimal at the scale of the error, and at the true profile.
        assert loss(log_error) < min(loss(log_error - 0.1), loss(log_error + 0.1))
        assert loss(log_error) == pytest.approx(1.0 + log_error, abs=1e-4)
        assert loss(log_error, shift=-error) == pytest.approx(log_error, abs=1e-4)

    def test_each_of_two_modes_explains_its_own_walls(self) -> None:
        near, far = torch.zeros(1, 2), torch.ones(1, 2)
        modes = WallModes(
            torch.stack([near, far], dim=2), torch.full((1, 2, 2), -3.0), torch.full((1, 2, 2), -math.log(2))
        )
        target = torch.tensor([[0.0, 1.0]])
        compromise = losses.laplace_mixture(walls(torch.full((1, 2), 0.5), math.log(0.5)), target)
        assert losses.laplace_mixture(modes, target) < compromise - 1.0
        known = torch.tensor([[True, False]])
        assert losses.laplace_mixture(modes, torch.tensor([[0.0, 9.0]]), known) < compromise


class TestStructure:
    def test_class_weights_follow_the_balance(self) -> None:
        logits, kind = torch.zeros(1, 4, 4), torch.tensor([[0, 0, 0, 1]])
        logits[..., 1] = -1.0
        share = torch.tensor([0.75, 0.25, 0.0, 0.0])
        likelihood = torch.log_softmax(logits[0], dim=1)
        for balance, weight in ((0.0, 1.0), (1.0, 3.0), (0.5, 3.0**0.5)):
            expected = -(3.0 * likelihood[0, 0] + weight * likelihood[3, 1]) / (3.0 + weight)
            torch.testing.assert_close(losses.opening(logits, kind, share, balance), expected)

    @pytest.mark.parametrize("balance", [0.0, 0.5, 1.0])
    def test_prior_is_the_best_constant_prediction(self, balance: float) -> None:
        share = torch.tensor([0.7, 0.15, 0.1, 0.05])
        kind = torch.repeat_interleave(torch.arange(4), (share * 100).round().long())[None]
        prior = losses.opening_prior(share, balance)
        logits = prior.log().expand(1, 100, 4).clone().requires_grad_()
        losses.opening(logits, kind, share, balance).backward()
        torch.testing.assert_close(present(logits.grad).sum(dim=1), torch.zeros(1, 4), atol=1e-6, rtol=0.0)

    def test_unknown_classes_are_ignored(self) -> None:
        logits = torch.randn(2, 3, 4, requires_grad=True)
        share = torch.full((4,), 0.25)
        kind = torch.tensor([[1, -1, 2], [-1, -1, -1]])
        losses.opening(logits, kind, share, 0.5).backward()
        assert (present(logits.grad).abs().sum(dim=2) > 0.0).tolist() == (kind >= 0).tolist()
        nothing = losses.opening(logits, torch.full((2, 3), -1), share, 0.5) + losses.room_type(
            logits[:, 0], torch.tensor([-1, -1])
        )
        assert nothing.item() == 0.0

    @pytest.mark.parametrize("log_error", [-0.3, 0.0, 0.2])
    def test_ceiling_loss_is_finite_and_minimal_at_the_truth(self, log_error: float) -> None:
        above = torch.tensor([0.8, 1.4])
        predicted = (above.log() + log_error).requires_grad_()
        loss = losses.ceiling(predicted, torch.full((2,), -2.0), above)
        assert loss.item() >= losses.ceiling(above.log(), torch.full((2,), -2.0), above).item()
        (gradient,) = torch.autograd.grad(loss, predicted)
        assert torch.equal(gradient.sign(), torch.full((2,), log_error).sign())
        # Of a camera at the ceiling.
        assert torch.isfinite(losses.ceiling(torch.zeros(1), torch.zeros(1), torch.tensor([-0.1])))

    def openings_gradient(self, probability: list[float], target: list[float]) -> torch.Tensor:
        """Return the gradient of the logits of one column."""
        logits = torch.tensor([[probability]]).log().requires_grad_()
        loss = losses.teacher_openings(logits, torch.tensor([[target]]), torch.ones(4))
        return torch.autograd.grad(loss, logits)[0][0, 0]

    def test_teacher_openings_leave_passages_free(self) -> None:
        target = [0.8, 0.1, math.nan]
        for passage in (1e-12, 0.05):
            gradient = self.openings_gradient([0.1 - passage, 0.8, 0.1, passage], target)
            torch.testing.assert_close(gradient, torch.zeros(4), atol=1e-6, rtol=0.0)
        without_door = self.openings_gradient([0.8, 0.1, 0.1, 1e-6], target)
        assert without_door[1] < 0.0 < without_door[0]

    def test_teacher_that_sees_passages_is_followed(self) -> None:
        probability = [0.2, 0.3, 0.1, 0.4]
        alike = self.openings_gradient(probability, probability[1:])
        torch.testing.assert_close(alike, torch.zeros(4), atol=1e-6, rtol=0.0)
        gradient = self.openings_gradient(probability, [0.3, 0.1, 0.6])
        assert gradient[3] < 0.0 < gradient[0]

    def test_weighted_teacher_is_followed_to_the_weighted_shares(self) -> None:
        share, weight = torch.tensor([0.6, 0.2, 0.1, 0.1]), torch.tensor([0.5, 2.0, 1.0, 2.0])
        logits = (share * weight).log()[None, None].requires_grad_()
        (gradient,) = torch.autograd.grad(losses.teacher_openings(logits, share[None, None, 1:], weight), logits)
        torch.testing.assert_close(gradient, torch.zeros_like(gradient), atol=1e-6, rtol=0.0)

    def test_shape_of_walls_ignores_their_scale(self) -> None:
        target, known = torch.randn(2, 9), torch.rand(2, 9) < 0.8
        scaled = target + torch.tensor([[0.7], [-0.4]])
        assert losses.wall_shape(walls(scaled, 0.0), target, known) < 1e-6
        bent = torch.where(known, scaled, 99.0)
        bent[:, 0] += 0.5
        known[:, 0] = True
        # Pictures count alike, however many of their walls are known.
        expected = (0.5 / known.sum(dim=1)).mean()
        torch.testing.assert_close(losses.wall_shape(walls(bent, 0.0), target, known), expected)

    def test_teacher_walls_are_ignored_at_passages(self) -> None:
        log_profile = torch.zeros(1, 4, requires_grad=True)
        target = torch.tensor([[1.0, math.nan, 1.0, -1.0]])
        # Wall, wall, passage, and a door or passage.
        probability = torch.tensor(
            [[[0.9, 0.0, 0.0, 0.1], [0.9, 0.0, 0.0, 0.1], [0.1, 0.0, 0.0, 0.9], [0, 0.6, 0, 0.4]]]
        )
        logits = (probability + 1e-9).log().requires_grad_()
        openings = torch.zeros(1, 4, 3)
        openings[..., 2] = math.nan
        known = losses.visible_walls(target, openings, logits)
        loss = losses.laplace_mixture(walls(log_profile, 0.0), target.nan_to_num(), known)
        gradient, logits_gradient = torch.autograd.grad(loss, [log_profile, logits], allow_unused=True)
        assert torch.equal(gradient.sign(), torch.tensor([[-1.0, 0.0, 0.0, 1.0]]))
        # The student must not reduce the loss by predicting a passage.
        assert logits_gradient is None
        assert losses.visible_walls(target, openings.nan_to_num(), logits).tolist() == [[True, False, True, True]]


class TestChamfer:
    @given(seeds(), st.integers(1, 12), st.integers(1, 12))
    def test_chamfer_distance_matches_brute_force(self, seed: int, n: int, m: int) -> None:
        rng = np.random.default_rng(seed)
        first, second = rng.normal(size=(2, n, 3)), rng.normal(size=(2, m, 3))
        for k in range(2):
            pairs = np.array([[np.linalg.norm(a - b) for b in second[k]] for a in first[k]])
            expected = pairs.min(axis=1).mean() + pairs.min(axis=0).mean()
            assert chamfer_distance(first, second)[k] == pytest.approx(expected, abs=1e-6)

    @given(seeds())
    def test_chamfer_distance_is_symmetric_and_equal_in_torch(self, seed: int) -> None:
        rng = np.random.default_rng(seed)
        first, second = rng.normal(size=(2, 10, 3)), rng.normal(size=(2, 7, 3))
        distance = chamfer_distance(first, second)
        np.testing.assert_allclose(chamfer_distance(second, first), distance)
        np.testing.assert_allclose(chamfer_distance(first, first[:, ::-1].copy()), 0.0, atol=1e-6)
        in_torch = chamfer_distance(torch.tensor(first), torch.tensor(second))
        np.testing.assert_allclose(in_torch.numpy(), distance)


class TestAccuracy:
    def test_missing_answers_count_as_misses(self) -> None:
        nan = float("nan")
        accuracy = Accuracy.from_errors(np.array([0.005, nan, 0.03, nan, 0.5]))
        assert accuracy.n == 5
        assert accuracy.within_1cm == pytest.approx(1 / 5)
        assert accuracy.within_5cm == accuracy.within_10cm == pytest.approx(2 / 5)
        assert accuracy.within_1m == pytest.approx(3 / 5)
        assert accuracy.median_cm == pytest.approx(50.0)
        assert Accuracy.from_errors(np.array([0.1, nan, nan])).median_cm == math.inf

    def test_limits_are_exclusive(self) -> None:
        accuracy = Accuracy.from_errors(np.array([0.01, 0.05, 0.10, 1.0]))
        shares = [accuracy.within_1cm, accuracy.within_5cm, accuracy.within_10cm, accuracy.within_1m]
        assert shares == [0.0, 0.25, 0.5, 0.75]

    @given(st.lists(st.floats(0.0, 10.0) | st.just(float("nan")), min_size=1, max_size=30))
    def test_shares_grow_with_the_limit(self, errors: list[float]) -> None:
        figures = vars(Accuracy.from_errors(np.array(errors)))
        shares = [figures[f"within_{limit}"] for limit in ("1cm", "5cm", "10cm", "1m")]
        assert shares == sorted(shares)
        assert shares[0] >= 0.0
        assert shares[-1] <= np.mean(~np.isnan(errors))
