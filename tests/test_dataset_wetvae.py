"""Stages 1 and 2: Table 1, Eq. 4, matching, MIG and SAP."""
import math

import common
import numpy as np
import pytest
import torch
from sklearn.linear_model import LinearRegression
from sklearn.metrics import mutual_info_score
from torch import distributions as D


def test_trajectories_have_constant_speed_and_turn(s1):
    path = s1.make_trajectories(np.array([0.7]), np.radians([30.0]), np.radians([10.0]), length=5)[0]
    assert path.shape == (6, 2) and np.allclose(path[0], 0)
    steps = np.diff(path, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.7)
    np.testing.assert_allclose(np.degrees(np.arctan2(steps[:, 1], steps[:, 0])), [30, 40, 50, 60, 70])


def test_data_set_from_the_command_line_follows_table_1(fork, tmp_path):
    for out, seed in (("a", 0), ("b", 0), ("c", 1)):
        done = fork("01_make_dataset", "--out", tmp_path / out, "--trajectories", 20_000, "--seed", seed)
        assert done.returncode == 0 and "Table 1" in done.stdout, done.stderr
    a, b, c = (np.load(tmp_path / f"{out}/runs/dataset_main_seed{seed}.npz") for out, seed in (("a", 0), ("b", 0), ("c", 1)))
    assert np.array_equal(a["factors"], b["factors"]) and not np.array_equal(a["factors"], c["factors"])
    speed, direction, curvature = a["factors"].T.astype(float)
    straight = curvature == 0
    assert abs(straight.mean() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / 20_000)
    for sample, low, high in ((speed, 0, 1), (direction, -math.pi / 2, math.pi / 2), (curvature[~straight], -math.pi / 6, math.pi / 6)):
        u = np.sort((sample - low) / (high - low))  # Kolmogorov-Smirnov against U(0, 1); 1.95 / sqrt(n) is its 0.1 % point
        assert u[0] >= 0 and u[-1] <= 1 and abs(u - (np.arange(len(u)) + 0.5) / len(u)).max() < 1.95 / math.sqrt(len(u))
    assert (tmp_path / "a/figures/fig09_dataset.png").stat().st_size > 10_000


def test_the_other_data_sets_from_the_command_line(fork, tmp_path):
    """Table 1's full circle and accelerations, read back from the trajectories by differences."""
    for experiment, columns in (("full", 2), ("polar", 2), ("speed_acc", 1), ("four_factors", 2)):
        assert fork("01_make_dataset", "--out", tmp_path, "--experiment", experiment, "--trajectories", 4000).returncode == 0
        data = np.load(tmp_path / f"runs/dataset_{experiment}_seed0.npz")
        steps, f = np.diff(data["trajectories"].astype(float), axis=1), dict(zip(data["names"], data["factors"].T.astype(float)))
        assert steps.shape == (4000, 5, columns) and f["speed"].min() < (0.01 if columns == 2 else -0.99) and f["speed"].max() > 0.99
        size = steps[..., 0] if columns == 1 else np.linalg.norm(steps, axis=2)
        if "direction" in f:
            np.testing.assert_allclose(np.exp(1j * f["direction"]), (steps[:, 0] @ [1, 1j]) / size[:, 0], atol=1e-2)
            assert f["direction"].min() < -3.13 and f["direction"].max() > 3.13
        if "acceleration" in f:
            np.testing.assert_allclose(size[:, 4] - size[:, 3], f["acceleration"] * f["speed"], atol=1e-5)
            assert abs((f["acceleration"] == 0).mean() - 0.2) < 0.03 and 0.19 < abs(f["acceleration"]).max() <= 0.2


def test_weak_labels_of_the_other_experiments():
    f = dict(speed=np.array([0.3, 0.9, 0.9]), direction=np.radians([10.0, 100, -10]), acceleration=np.array([0, 0.1, -0.1]))
    labels = common.weak_labels(f, ["angle", "x", "y", "velocity", "acceleration"])
    assert labels.tolist() == [[0, 2, 2, 2, 0], [1, 1, 3, 3, 1], [3, 3, 1, 3, 2]]  # by hand
    assert common.weak_labels(dict(speed=np.array([-1.0, -0.3])), ["velocity"])[:, 0].tolist() == [0, 1]


def test_accelerating_factors_are_read_back(s1):
    rng = np.random.default_rng(0)
    speed, acceleration = rng.uniform(0.2, 1, 50) * rng.choice([-1, 1], 50), rng.uniform(-0.2, 0.2, 50)
    found = common.factors_of(np.diff(s1.make_trajectories(speed, acceleration=acceleration), axis=1), accelerating=True)
    np.testing.assert_allclose(found["speed"], speed)
    np.testing.assert_allclose(found["acceleration"], acceleration, atol=1e-12)


def test_spread_of_directions_closes_in_a_circle():
    assert common.spread(np.radians([170.0, -170, 180]), "direction") == pytest.approx(math.radians(20))
    assert common.spread(np.radians([-70.0, 0, 70]), "direction") == pytest.approx(math.radians(140))
    assert common.spread(np.radians([-70.0, 0, 70]), "curvature") == pytest.approx(math.radians(140))


def test_direction_on_a_circle(s2):
    """Canonical z_dir counts in thirds of a turn; sign and offset of the latents are found again; the KL is that of a narrow normal
    against U(0, 2 pi), by numerical integration."""
    direction = np.random.default_rng(0).uniform(-math.pi, math.pi, 3000)
    raw = np.stack([np.cos(2 - direction), np.sin(2 - direction)], 1)  # sign -1, offset 2
    sign, offset, closeness = s2.match_circle(raw, direction)
    assert sign == -1 and offset == pytest.approx(2) and closeness == pytest.approx(1)
    decoder = common.Decoder(2, circle=True)
    decoder.axes, decoder.circle = torch.tensor([[0.0, 0, 1], [0, 0, 0]]), torch.tensor([1.0, sign, offset])
    latents = decoder.latents(torch.tensor([[0.3, 1.0], [-0.2, -1.5]]))
    angle = np.array([2 - 2 * math.pi / 3, 2 + math.pi])
    np.testing.assert_allclose(latents, np.stack([np.cos(angle), np.sin(angle), [0.3, -0.2]], 1), atol=1e-6)
    torch.testing.assert_close(decoder(torch.tensor([[0.3, 1.5]]), 3)[0], decoder(torch.tensor([[0.3, -1.5]]), 3)[0])  # closed
    log_var = torch.full((1, 3), 2 * math.log(0.3))
    _, kl = s2.sample(torch.tensor([[0.0, 2.0, 0.5]]), log_var, True)
    grid = np.linspace(-math.pi, math.pi, 200_001)
    p = np.exp(-0.5 * (grid / 0.3) ** 2) / (0.3 * math.sqrt(2 * math.pi))
    assert kl[0, 0].item() == pytest.approx(np.trapezoid(p * np.log(np.maximum(p, 1e-300) * 2 * math.pi), grid), abs=1e-4)
    assert kl[0, 1].item() == pytest.approx(D.kl_divergence(D.Normal(0.5, 0.3), D.Normal(0.0, 1.0)).item())
    angles = torch.atan2(*s2.sample(torch.tensor([[0.0, 2.0, 0.5]]).expand(20_000, 3), log_var.expand(20_000, 3), True)[0][:, :2].flip(1).unbind(1))
    assert angles.mean().item() == pytest.approx(math.pi / 2, abs=0.01) and angles.std().item() == pytest.approx(0.3, abs=0.01)


def test_ordered_labels_lie_on_their_axis_in_order(s2):
    """Along the axis the likeliest class goes up by neighbours only: right, straight, left; round the circle 0, 1, 2, 3 and back to 0."""
    z = torch.linspace(-4, 4, 401)[:, None]
    assert list(dict.fromkeys(s2.Ordered(3, False)(z).softmax(1).add(torch.tensor([1e-3, 0, 0])).argmax(1).tolist())) == [2, 0, 1]
    four = s2.Ordered(4, False)
    four.bias.data = torch.tensor([0.0, 2.0, 2.0, 0.0])
    assert list(dict.fromkeys(four(z).argmax(1).tolist())) == [0, 1, 2, 3]
    turn = torch.linspace(-0.1, 6.1, 401)
    assert list(dict.fromkeys(s2.Ordered(4, True)(torch.stack([turn.cos(), turn.sin()], 1)).argmax(1).tolist())) == [0, 1, 2, 3]
    heads, parts = s2.label_decoders(["speed", "angle", "curvature"], 4, True, True)
    assert parts == [slice(2, 3), slice(0, 2), slice(3, 4)]
    assert [head(torch.zeros(5, 4)[:, part]).shape for head, part in zip(heads, parts)] == [(5, 4), (5, 4), (5, 3)]
    assert s2.label_decoders(["speed", "curvature"], 3, False, False)[1] == [slice(None)] * 2  # Eq. 4: every label from all of z


def test_matching_allows_a_direction_to_be_cut_open_anywhere(s2):
    direction = np.random.default_rng(0).uniform(-math.pi, math.pi, 3000)
    latent = -((direction - 1.0) % (2 * math.pi))  # cut at 1 radian, falling
    axes, corr = s2.match_axes(latent[:, None], direction[:, None], ["direction"])
    assert axes.tolist() == [[-1]] and corr[0] > 0.98 and abs(np.corrcoef(latent, direction)[0, 1]) < 0.6


def test_objective_is_equation_4_term_by_term(s2):
    torch.manual_seed(0)
    encoder, decoder = s2.Encoder(2, 7, 3), s2.Decoder(3)
    heads = torch.nn.ModuleList(torch.nn.Linear(3, k) for k in (4, 3))
    x, y = torch.randn(50, 5, 2), torch.stack([torch.randint(4, (50,)), torch.randint(3, (50,))], 1)
    torch.manual_seed(1)
    states, labels, kl = s2.objective(encoder, decoder, heads, [slice(None)] * 2, x, y, [4, 3])

    one_hot = torch.zeros(50, 7)
    one_hot[range(50), y[:, 0]] = 1
    one_hot[range(50), 4 + y[:, 1]] = 1
    mean, log_var = encoder(x, one_hot)
    posterior = D.Normal(mean, (0.5 * log_var).exp())
    torch.manual_seed(1)
    z = mean + (0.5 * log_var).exp() * torch.randn(50, 3)
    m, v = decoder(z, 5)
    torch.testing.assert_close(states, D.Independent(D.Normal(m, (0.5 * v).exp()), 2).log_prob(x).mean())
    torch.testing.assert_close(labels, sum(D.Categorical(logits=head(z)).log_prob(y[:, i]) for i, head in enumerate(heads)).mean())
    torch.testing.assert_close(kl, D.kl_divergence(posterior, D.Normal(0.0, 1.0)).sum(1).mean())


def test_matching_finds_a_known_signed_permutation(s2):
    rng = np.random.default_rng(0)
    factors = rng.normal(size=(2000, 3))
    latents = np.stack([factors[:, 2], -factors[:, 0], factors[:, 1]], 1) + 0.1 * rng.normal(size=(2000, 3))
    axes, corr = s2.match_axes(latents, factors, ["speed", "x", "y"])
    assert axes.tolist() == [[0, -1, 0], [0, 0, 1], [1, 0, 0]] and (corr > 0.98).all()
    canonical = latents @ axes.numpy().T
    assert all(np.corrcoef(canonical[:, m], factors[:, m])[0, 1] > 0.98 for m in range(3))


def test_mig_and_sap_against_scikit_learn(s2):
    rng = np.random.default_rng(0)
    factors = rng.uniform(size=(4000, 2))
    z = np.stack([factors[:, 0] + 0.3 * factors[:, 1], factors[:, 1] + 0.1 * rng.normal(size=4000)], 1)
    mig, sap = s2.mig_and_sap(z, factors)
    codes = lambda v: np.floor(20 * v.argsort().argsort() / len(v))  # noqa: E731  equal-count bins by rank
    for j in range(2):
        information = sorted(mutual_info_score(codes(latent), codes(factors[:, j])) for latent in z.T)
        assert abs(mig[j] - (information[1] - information[0]) / math.log(20)) < 5e-3
        r2 = sorted(LinearRegression().fit(latent[:, None], factors[:, j]).score(latent[:, None], factors[:, j]) for latent in z.T)
        assert abs(sap[j] - (r2[1] - r2[0])) < 1e-6
