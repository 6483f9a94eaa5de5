"""Stages 1 and 2: Table 1, Eq. 4, matching, MIG and SAP."""
import math

import numpy as np
import torch
from conftest import cli
from sklearn.linear_model import LinearRegression
from sklearn.metrics import mutual_info_score
from torch import distributions as D


def test_trajectories_have_constant_speed_and_turn(s1):
    path = s1.make_trajectories(np.array([0.7]), np.radians([30.0]), np.radians([10.0]), 5)[0]
    assert path.shape == (6, 2) and np.allclose(path[0], 0)
    steps = np.diff(path, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.7)
    np.testing.assert_allclose(np.degrees(np.arctan2(steps[:, 1], steps[:, 0])), [30, 40, 50, 60, 70])


def test_data_set_from_the_command_line_follows_table_1(tmp_path):
    for out, seed in (("a", 0), ("b", 0), ("c", 1)):
        done = cli("01_make_dataset", "--out", tmp_path / out, "--trajectories", 20_000, "--seed", seed)
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


def test_objective_is_equation_4_term_by_term(s2):
    torch.manual_seed(0)
    encoder, decoder = s2.Encoder(2, 7, 3), s2.Decoder(3)
    heads = torch.nn.ModuleList(torch.nn.Linear(3, k) for k in (4, 3))
    x, y = torch.randn(50, 5, 2), torch.stack([torch.randint(4, (50,)), torch.randint(3, (50,))], 1)
    torch.manual_seed(1)
    states, labels, kl = s2.objective(encoder, decoder, heads, x, y, [4, 3])

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
    axes, corr = s2.match_axes(latents, factors)
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
