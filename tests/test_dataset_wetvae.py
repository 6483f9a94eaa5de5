"""Stages 1 and 2: Table 1, weak labels, Eq. 4, "check factors in z", and what a user runs and mistypes."""
import csv
import math
import os

import common
import numpy as np
import pytest
import torch
from conftest import ROOT, script
from torch import distributions as D

TINY = ("--epochs", 1, "--batch", 500, "--hidden", 16)
FULL = {"direction": (-math.pi, math.pi)}
STAGE = script("02_train_wetvae")


@pytest.fixture(scope="module")
def data(fork, tmp_path_factory):
    """A folder with a small data set of each row of 01."""
    out = tmp_path_factory.mktemp("data")
    for experiment in script("01_make_dataset").EXPERIMENTS:
        done = fork("01_make_dataset", "--out", out, "--experiment", experiment, "--trajectories", 1000)
        assert done.returncode == 0 and "Table 1" in done.stdout, done.stderr
    return out


@pytest.fixture
def out(data, tmp_path):
    """A folder of its own with these data sets."""
    for path in data.glob("*.npz"):
        os.link(path, tmp_path / path.name)
    return tmp_path


def one_line(done, code=2):
    return done.returncode == code and len(done.stderr.splitlines()) == 1 and "Traceback" not in done.stderr


def rows_of(out):
    with open(out / "results" / "wetvae.csv", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def artifact(out, variant, kind="wetvae"):
    return common.load(out, kind, variant, 0)


# ---------------------------------------------------------------- stage 1

def test_a_trajectory_has_constant_speed_and_turn(s1):
    path = s1.make_trajectories(np.array([0.7]), np.radians([30.0]), np.radians([10.0]), length=5)[0]
    assert path.shape == (6, 2) and np.allclose(path[0], 0)
    steps = np.diff(path, axis=0)
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 0.7)
    np.testing.assert_allclose(np.degrees(np.arctan2(steps[:, 1], steps[:, 0])), [30, 40, 50, 60, 70])


def test_the_data_set_follows_table_1(fork, data, tmp_path):
    done = fork("01_make_dataset", "--out", tmp_path, "--trajectories", 20_000, "--seed", 1)
    assert done.returncode == 0, done.stderr
    a = np.load(tmp_path / "dataset_main_seed1.npz")
    assert a["names"].tolist() == ["speed", "direction", "curvature"]
    assert a["factors"][0, 0] != np.load(data / "dataset_main_seed0.npz")["factors"][0, 0]  # the seed counts
    np.testing.assert_allclose(a["ranges"], [(0, 1), (-math.pi / 2, math.pi / 2), (-math.pi / 6, math.pi / 6)])
    speed, direction, curvature = a["factors"].T.astype(float)
    straight = curvature == 0
    assert abs(straight.mean() - 0.2) < 4 * math.sqrt(0.2 * 0.8 / 20_000)
    for sample, (low, high) in zip((speed, direction, curvature[~straight]), a["ranges"]):
        u = np.sort((sample - low) / (high - low))  # Kolmogorov-Smirnov against U(0, 1), at its 0.1 % point
        assert u[0] >= 0 and u[-1] <= 1
        assert abs(u - (np.arange(len(u)) + 0.5) / len(u)).max() < 1.95 / math.sqrt(len(u))
    assert (tmp_path / "figures/fig09_dataset.png").stat().st_size > 10_000


def test_the_other_data_sets_by_differences(data):
    for experiment, columns in (("full", 2), ("polar", 2), ("speed_acc", 1), ("four_factors", 2)):
        content = np.load(data / f"dataset_{experiment}_seed0.npz")
        steps = np.diff(content["trajectories"].astype(float), axis=1)
        f = dict(zip(content["names"], content["factors"].T.astype(float)))
        assert steps.shape == (1000, 5, columns)
        assert f["speed"].min() < (0.01 if columns == 2 else -0.98) and f["speed"].max() > 0.98
        size = steps[..., 0] if columns == 1 else np.linalg.norm(steps, axis=2)
        if "direction" in f:
            np.testing.assert_allclose(np.exp(1j * f["direction"]), (steps[:, 0] @ [1, 1j]) / size[:, 0], atol=1e-2)
            assert f["direction"].min() < -3.1 and f["direction"].max() > 3.1
        if "acceleration" in f:
            np.testing.assert_allclose(size[:, 4] - size[:, 3], f["acceleration"] * f["speed"], atol=1e-5)
            assert abs((f["acceleration"] == 0).mean() - 0.2) < 0.05 and 0.19 < abs(f["acceleration"]).max() <= 0.2


def test_in_one_dimension_a_speed_may_have_any_range(fork, tmp_path):
    for low, high in ((-0.5, 0.25), (0.2, 0.4)):
        done = fork("01_make_dataset", "--out", tmp_path, "--experiment", "speed_acc", "--trajectories", 1000, "--length", 10,
                    "--speed_low", low, "--speed_high", high)
        assert done.returncode == 0, done.stderr
        content = np.load(tmp_path / "dataset_speed_acc_seed0.npz")
        speed, first = content["factors"][:, 0], content["trajectories"][:, 1, 0]
        np.testing.assert_allclose(content["ranges"][0], (low, high))
        np.testing.assert_allclose((speed.min(), speed.max()), (low, high), atol=0.01)
        np.testing.assert_allclose(first, speed, atol=1e-6)


def test_data_of_three_factors_hold_the_example(fork, data, tmp_path):
    """Speed 0.6, direction 20 and curvature -10 degrees, step by step."""
    assert fork("01_make_dataset", "--out", tmp_path, "--trajectories", 500, "--length", 3).returncode == 0
    for out, experiment, length in ((data, "main", 5), (data, "full", 5), (tmp_path, "main", 3)):
        points = [(0.0, 0.0)]
        for t in range(length):
            angle = math.radians(20 - 10 * t)
            points.append((points[-1][0] + 0.6 * math.cos(angle), points[-1][1] + 0.6 * math.sin(angle)))
        content = np.load(out / f"dataset_{experiment}_seed0.npz")
        np.testing.assert_allclose(content["example"], [points], atol=1e-6)
        assert content["example"].dtype == content["trajectories"].dtype  # 02 reads both alike
        np.testing.assert_allclose(content["example_factors"], [(0.6, math.pi / 9, -math.pi / 18)])
    for experiment in ("polar", "speed_acc", "four_factors"):
        assert not [name for name in np.load(data / f"dataset_{experiment}_seed0.npz") if name.startswith("example")]


def test_the_order_of_factors_is_that_of_z(fork, data, tmp_path):
    flags = ("--out", tmp_path, "--trajectories", 1000)
    assert fork("01_make_dataset", *flags, "--factors", "curvature direction speed").returncode == 0
    a, b = (np.load(out / "dataset_main_seed0.npz") for out in (tmp_path, data))
    assert all(np.array_equal(a[key], b[key]) for key in ("trajectories", "factors", "names", "ranges"))


@pytest.mark.parametrize("flags, words", [
    (("--curvature", 0), "curvature never changes"), (("--direction", 0), "direction never changes"),
    (("--speed_low", 1), "speed never changes"), (("--straight", 1), "curvature never changes"),
    (("--length", 1), "curvature needs --length 2 or more"), (("--direction", 200), "from 0 to 180"),
    (("--speed_low", -1), "with direction --speed_low must be at least 0"), (("--trajectories", 0), "at least 1"),
    (("--experiment", "polar", "--speed_low", -1e-3), "with direction --speed_low must be at least 0"),
    (("--experiment", "speed_acc", "--speed_low", 1), "speed never changes"),
    (("--experiment", "speed_acc", "--acceleration", 0), "acceleration never changes"),
    (("--length", 0), "at least 1"), (("--length", 2.5), "whole number"),
    (("--factors", "direction"), "must name speed"), (("--factors", "speed height"), "must name speed"),
    (("--factors", "speed curvature"), "curvature needs direction")])
def test_01_ends_with_one_line(s1, inside, tmp_path, flags, words):
    done = inside(s1, "--out", tmp_path, *flags)
    assert one_line(done) and words in done.stderr and not list(tmp_path.glob("*.npz")), done.stderr


# ---------------------------------------------------------------- weak labels, and what measures decoded factors

def test_the_papers_example_of_weak_labels():
    f = dict(speed=np.array([0.1]), direction=np.radians([40.0]), curvature=np.radians([-10.0]))
    ranges = dict(speed=(0, 1), direction=(-math.pi / 2, math.pi / 2), curvature=(-math.pi / 6, math.pi / 6))
    assert (common.weak_labels(f, list(f), ranges) + 1).tolist() == [[1, 2, 3]]  # App. A.1.1


def test_weak_labels_follow_the_ranges():
    """By hand: quarters of the full circle from the left downwards, speeds of one dimension, x and y, other limits."""
    f = dict(speed=np.array([-1.0, -0.3, 0.3, 0.9]), direction=np.radians([100.0, 10, -10, -170]),
             x=np.array([-1.9, -0.1, 0.1, 1.9]), acceleration=np.array([0, 0.1, -0.1, 0]))
    labels = common.weak_labels(f, list(f), dict(speed=(-1, 1), x=(-2, 2)) | FULL)
    assert labels.T.tolist() == [[0, 1, 2, 3], [0, 1, 2, 3], [0, 1, 2, 3], [0, 1, 2, 0]]


def test_factors_are_read_back(s1):
    rng = np.random.default_rng(0)
    f = dict(speed=rng.uniform(0.2, 1, 50), direction=rng.uniform(-3.1, 3.1, 50), curvature=rng.uniform(-0.5, 0.5, 50),
             acceleration=rng.uniform(-0.2, 0.2, 50))
    found = common.factors_of(np.diff(s1.make_trajectories(**f), axis=1), list(f))
    for name in f:
        np.testing.assert_allclose(found[name], f[name], atol=1e-12)


def test_purity_and_the_circle_of_directions():
    assert common.spread(np.radians([170.0, -170, 180]), "direction") == pytest.approx(math.radians(20))
    assert common.spread(np.radians([-70.0, 0, 70]), "direction") == pytest.approx(math.radians(140))
    curves = [dict(speed=np.array([0, 0.6]), curvature=np.array([0.0, 0.2])),
              dict(speed=np.array([0, 0.05]), curvature=np.zeros(2))]
    C, purity = common.cross_talk(curves, dict(speed=(0, 1), curvature=(-1, 1)))
    np.testing.assert_allclose(C, [[0.6, 0.1], [0.05, 0]])
    assert purity[0] == pytest.approx(6 / 7) and math.isnan(purity[1])  # the second is dead


# ---------------------------------------------------------------- Eq. 4

def test_objective_is_equation_4_term_by_term(s2):
    torch.manual_seed(0)
    encoder, decoder = s2.Encoder(2, 7, 3, 16), s2.Decoder(3, 2, 16)
    heads = s2.LabelDecoders(["speed", "curvature"], 3, 16, False)
    x, y = torch.randn(50, 5, 2), torch.stack([torch.randint(4, (50,)), torch.randint(3, (50,))], 1)
    one_hot = torch.zeros(50, 7)
    one_hot[range(50), y[:, 0]] = 1
    one_hot[range(50), 4 + y[:, 1]] = 1
    torch.manual_seed(1)
    states, labels, kl = s2.objective(encoder, decoder, heads, x, one_hot, y)

    mean, log_var = encoder(x, one_hot)
    torch.manual_seed(1)
    z = mean + (0.5 * log_var).exp() * torch.randn(50, 3)
    m, v = decoder(z, 5)
    torch.testing.assert_close(states, D.Independent(D.Normal(m, (0.5 * v).exp()), 2).log_prob(x).mean())
    by_hand = sum(D.Categorical(logits=logits).log_prob(y[:, i]) for i, logits in enumerate(heads(z))).mean()
    torch.testing.assert_close(labels, by_hand)
    posterior = D.Normal(mean, (0.5 * log_var).exp())
    torch.testing.assert_close(kl, D.kl_divergence(posterior, D.Normal(0.0, 1.0)).sum(1).mean())


def test_the_decoder_never_reads_the_truth():
    """Its output for z depends on z alone, and it goes on past the T of the training."""
    torch.manual_seed(0)
    decoder = common.Decoder(3, 2, 16)
    z = torch.randn(4, 3)
    torch.testing.assert_close(decoder(z, 10)[0][:, :5], decoder(z, 5)[0])


def hyper(**changed):
    """The hyperparameters of the model main, as 02 hands them to training."""
    config = {name: getattr(STAGE, name) for name in common.types_of(vars(STAGE))}
    return STAGE.hyperparameters("main", config, {name.upper(): value for name, value in changed.items()})


def test_beta_grows_over_the_first_half_and_the_learning_rate_falls(s2, monkeypatch):
    betas, rates, real = [], [], torch.optim.Adam

    class Adam(real):
        def step(self, *arguments):
            rates.append(self.param_groups[0]["lr"])
            return super().step(*arguments)

    def objective(encoder, decoder, label_decoders, x, one_hot, y):
        kl = decoder.head[2].weight.sum()
        kl.register_hook(lambda gradient: betas.append(gradient.item()))  # d loss / d KL = beta
        return kl * 0, 0, kl
    monkeypatch.setattr(s2, "objective", objective)
    monkeypatch.setattr(torch.optim, "Adam", Adam)
    settings = hyper(epochs=2, batch=2, learning_rate=1e-3, beta=8.0, beta_warm_up=0.5, hidden=4, labelled=False)
    s2.train(torch.zeros(8, 5, 2), torch.zeros(8, 0), torch.zeros(8, 3), ["speed", "direction", "curvature"], settings)
    assert betas == pytest.approx([0, 2, 4, 6, 8, 8, 8, 8])
    assert rates == pytest.approx(1e-3 * (1 - np.arange(8) / 8))


def test_labels_are_read_from_their_own_latent_in_order(s2):
    names = ["speed", "curvature"]
    own, printed = (s2.LabelDecoders(names, 2, 16, flag) for flag in (True, False))
    z = torch.randn(50, 2, requires_grad=True)
    for heads, crosses in ((own, False), (printed, True)):
        gradient = torch.autograd.grad(heads(z)[0].square().sum(), z)[0]
        assert gradient[:, 0].any() and bool(gradient[:, 1].any()) == crosses  # Eq. 4: every label from all of z
    along = torch.linspace(-4, 4, 401)[:, None].repeat(1, 2)
    own.bias[0].data, own.bias[1].data = torch.tensor([0.0, 2, 2, 0]), torch.tensor([1e-3, 0, 0])
    speed, curvature = (list(dict.fromkeys(logits.argmax(1).tolist())) for logits in own(along))
    assert speed in ([0, 1, 2, 3], [3, 2, 1, 0]) and curvature == [2, 0, 1]  # right, straight, left


# ---------------------------------------------------------------- Alg. 1, "Test: check factors in z"

class ClosedForm:
    """A decoder by a formula: latents (B, M), steps -> displacements."""
    def __init__(self, z_dim, formula):
        self.axes, self.formula = torch.eye(z_dim), formula

    def __call__(self, z, steps):
        return self.decode_latents(z @ self.axes, steps)

    def decode_latents(self, z, steps):
        return self.formula(z, steps), None


def test_check_factors_finds_a_known_signed_permutation(s2):
    """Latent 0 is minus the curvature, 1 the speed, 2 minus the direction."""
    def formula(z, steps):
        speed, heading = 0.5 + 0.1 * z[:, 1:2], -0.5 * z[:, 2:] - 0.1 * z[:, :1] * torch.arange(steps)
        return speed[..., None] * torch.stack([heading.cos(), heading.sin()], 2)
    decoder = ClosedForm(3, formula)
    corr = s2.check_factors(decoder, ["speed", "direction", "curvature"], 5)
    assert decoder.axes.tolist() == [[0, 1, 0], [0, 0, -1], [-1, 0, 0]] and corr.min() > 0.99
    canonical = torch.tensor([[1.0, 0.4, 2.0]])
    found = common.factors_of(decoder(canonical, 5)[0].double().numpy(), ["speed", "direction", "curvature"])
    assert [round(found[name].item(), 4) for name in found] == [0.6, 0.2, 0.2]


def test_an_unused_latent_correlates_with_nothing(s2):
    decoder = ClosedForm(2, lambda z, steps: z[:, None, :1].expand(-1, steps, 1))
    speed, acceleration = s2.check_factors(decoder, ["speed", "acceleration"], 5)
    assert speed == pytest.approx(1) and acceleration == 0


@pytest.mark.parametrize("experiment, most", [("main", 90), ("full", 180)])
def test_the_shipped_decoder_means_what_its_axes_say(tmp_path, experiment, most):
    """most: degrees, the largest direction of the data."""
    model = common.load(tmp_path, "wetvae", experiment, 0)
    assert model["names"] == ["speed", "direction", "curvature"] and model["length"] == 5
    for axis, name in enumerate(model["names"]):
        z = torch.zeros(7, 3)
        z[:, axis] = torch.linspace(-1.5, 1.5, 7)
        found = common.factors_of(model["decoder"](z, 5)[0].double().numpy(), model["names"])[name]
        assert (np.diff(found) > 0).all(), name  # + is faster, counter-clockwise, left
        if name == "direction":
            assert -most < np.degrees(found[0]) < -most / 2 and most / 2 < np.degrees(found[-1]) < most


# ---------------------------------------------------------------- as a user runs it

GROUPS = {  # experiment and labels in results/wetvae.csv: a model beside which others differ, and in what
    "main": ("main", "main"), "main_none": ("main", "none"), "polar_cartesian": ("polar", "cartesian"), "polar": ("polar", "polar"),
    "full": ("full", "full"), "speed_acc_none": ("speed_acc", "none"), "seeds_own_axis": ("seeds", "own_axis"),
    "beta_gamma": ("beta_gamma", "beta_gamma"), "beta_gamma_b3_g10": ("beta_gamma", "b3_g10")}


@pytest.mark.parametrize("name", STAGE.MODELS)
def test_each_model_alone_from_training_to_figure(s2, inside, out, name, monkeypatch):
    """As common.load advises for a decoder that is missing; the file's constants stay what they are."""
    drawn = []
    before = {key: value for key, value in vars(s2).items() if key.isupper()}
    monkeypatch.setattr(s2, "train", lambda *given, train=s2.train: (
        drawn.append({key: getattr(s2, key) for key in ("BETA", "GAMMA", "LABELS", "DATA")}) or train(*given)))
    done = inside(s2, "--out", out, "--experiment", name, *TINY)
    assert done.returncode == 0, done.stderr
    assert drawn == [{key: before[key] for key in drawn[0]}]  # a model is handed its settings: no global changes
    model = artifact(out, name)
    names = model["names"]
    rows = rows_of(out)
    assert [row["factor"] for row in rows] == names and {row["settings"] for row in rows} == {common.digest(model["config"])}
    assert {(row["experiment"], row["labels"]) for row in rows} == {GROUPS.get(name, (rows[0]["experiment"], rows[0]["labels"]))}
    assert set(model["ranges"]) == set(names) and len(model["abs_corr"]) == len(names) and model["length"] == 5
    axes = model["decoder"].axes
    torch.testing.assert_close(axes @ axes.T, torch.eye(len(names)))  # a signed permutation
    assert abs(axes).sum() == len(names)
    wanted = {key: value for key, value in s2.MODELS[name].items() if key not in ("EPOCHS", "BATCH")}
    assert {key: model["config"][key] for key in wanted} == wanted
    assert (len(model["example"]) == 3) == (names == ["speed", "direction", "curvature"] and model["config"]["LABELLED"])


@pytest.mark.parametrize("figure", ["fig04_latent_traversals", "fig12_speed_acceleration"])
def test_a_figure_trains_and_shows_its_models(s2, fork, out, figure):
    done = fork("02_train_wetvae", "--out", out, "--experiment", figure, *TINY)
    assert done.returncode == 0, done.stderr
    assert [path.stem for path in (out / "figures").iterdir()] == [figure]
    assert {path.name for path in out.glob("*.pt")} == {f"wetvae_{column[1]}_seed0.pt" for column in s2.FIGURES[figure]}
    assert "no latent means" in done.stdout  # one epoch teaches nothing, and that is said aloud
    assert not [path for path in out.rglob("*.partial")]


def test_the_columns_of_figures_are_models(s2):
    assert set(GROUPS) <= set(s2.MODELS)
    assert {model for columns in s2.FIGURES.values() for _, model, _ in columns} <= set(s2.MODELS)


def test_measuring_alone_changes_no_model_and_knows_what_made_it(s2, inside, out, monkeypatch):
    flags = ("--out", out, "--experiment", "main", *TINY)
    assert inside(s2, *flags).returncode == 0
    before = (out / "wetvae_main_seed0.pt").read_bytes()
    (out / "results/wetvae.csv").unlink()
    done = inside(s2, *flags, "--train", "false")
    assert done.returncode == 0 and len(rows_of(out)) == 3 and (out / "wetvae_main_seed0.pt").read_bytes() == before
    for name, value in (("BETA", 2), ("Z_RANGE", 1)):
        done = inside(s2, *flags, "--train", "false", f"--{name.lower()}", value)
        assert one_line(done) and f"made with {name} = " in done.stderr, done.stderr
    monkeypatch.setattr(common, "CLASSES", common.CLASSES | dict(speed=5))
    done = inside(s2, *flags, "--train", "false")
    assert one_line(done) and "made with CLASSES = " in done.stderr


def test_a_number_edited_in_the_file_is_of_its_declared_type(s2, inside, out):
    s2.BETA, s2.GAMMA = 4, 20
    done = inside(s2, "--out", out, "--experiment", "main", "--beta", 0.5, *TINY)
    assert done.returncode == 0, done.stderr
    config = artifact(out, "main")["config"]
    assert (config["BETA"], config["GAMMA"]) == (0.5, 20)


def test_the_example_of_all_four_scripts():
    for factors, labels in (((0.6, 20, -10), [3, 2, 3]), ((0.1, 40, -10), [1, 2, 3])):  # the second: the paper's
        found = dict(speed=np.array([factors[0]]), direction=np.radians(factors[1:2]), curvature=np.radians(factors[2:]))
        ranges = dict(speed=(0, 1), direction=(-math.pi / 2, math.pi / 2))
        assert (common.weak_labels(found, list(found), ranges)[0] + 1).tolist() == labels


def test_the_example_of_the_data_goes_through_encoder_and_axes(s2, inside, out, monkeypatch):
    """By hand: labels 3, 2, 3 of 4, 4 and 3 classes; the decoder turns z of the artifact into the encoder's mean."""
    turned = torch.tensor([[0.0, -1, 0], [0, 0, 1], [1, 0, 0]])  # not its own inverse
    monkeypatch.setattr(s2, "check_factors", lambda decoder, *_: decoder.axes.copy_(turned).diagonal())
    done = inside(s2, "--out", out, "--experiment", "main", *TINY)
    model, encoder, one_hot = artifact(out, "main"), s2.Encoder(2, 11, 3, 16), torch.zeros(1, 11)
    encoder.load_state_dict(model["encoder"])
    one_hot[0, [2, 4 + 1, 8 + 2]] = 1
    heading = torch.deg2rad(torch.tensor([20.0, 10, 0, -10, -20]))
    mean, _ = encoder(0.6 * torch.stack([heading.cos(), heading.sin()], 1)[None], one_hot)
    torch.testing.assert_close(torch.tensor([model["example"]]) @ model["decoder"].axes, mean, atol=1e-5, rtol=1e-5)
    assert "encoded: z = speed {:+.2f}, direction {:+.2f}, curvature {:+.2f}".format(*model["example"]) in done.stdout


def test_beta_gamma_is_eq_4_as_printed():
    as_printed = dict(BETA=9, GAMMA=10, OWN_AXIS=False, BETA_WARM_UP=0)
    config = {name: getattr(STAGE, name) for name in common.types_of(vars(STAGE))}
    assert STAGE.hyperparameters("beta_gamma", config, {}) == STAGE.hyperparameters("main", config, as_printed)
    assert STAGE.hyperparameters("beta_gamma_b1_g10", config, {}) == STAGE.hyperparameters("main", config, as_printed | dict(BETA=1))


def test_a_loss_that_is_not_finite_overwrites_nothing(fork, out):
    done = fork("02_train_wetvae", "--out", out, *TINY, "--learning_rate", 1e30)
    assert one_line(done, 1) and "nothing was overwritten" in done.stderr and not list(out.glob("*.pt")), done.stderr


def test_settings_of_a_model_have_the_same_digits_for_all_seeds(s2, inside, out):
    for seed in (0, 1):
        if seed:
            assert inside(script("01_make_dataset"), "--out", out, "--experiment", "speed_acc", "--seed", 1,
                          "--trajectories", 1000).returncode == 0
        done = inside(s2, "--out", out, "--experiment", "fig12_speed_acceleration", "--seed", seed, *TINY)
        assert done.returncode == 0, done.stderr
    digits = {(row["seed"], row["labels"]): row["settings"] for row in rows_of(out)}
    assert len(digits) == 4 and len(set(digits.values())) == 2  # a model of each label, whatever the seed
    assert digits["0", "speed_acc"] == digits["1", "speed_acc"] != digits["1", "none"]


@pytest.mark.parametrize("flags, words", [
    (("--labels", "speed acceleration"), "acceleration"), (("--labels", ""), "must be factors"),
    (("--base", "0 0"), "unrecognized arguments: --base"), (("--batch", 0), "--batch"), (("--epochs", 0), "--epochs"),
    (("--batch", 1001), "fewer than --batch"), (("--labels", "x y"), "of class 1"), (("--hidden", 2.5), "whole number"),
    (("--beta", "much"), "a number"), (("--data", "mine"), "01_make_dataset"), (("--data", "speed_acc"), "direction"),
    (("--experiment", "mine"), "allowed: fig04"), (("--train", "false", "--seed", 77), "02_train_wetvae.py")])
def test_02_ends_with_one_line_before_training(s2, inside, out, flags, words):
    done = inside(s2, "--out", out, *flags)
    assert one_line(done) and words in done.stderr and not list(out.glob("*.pt")), done.stderr


def test_data_of_other_settings_just_work(fork, tmp_path):
    made = ("--trajectories", 1000, "--length", 2, "--direction", 180, "--speed_low", 0.5)
    assert fork("01_make_dataset", "--out", tmp_path, *made).returncode == 0
    done = fork("02_train_wetvae", "--out", tmp_path, "--experiment", "full", "--data", "main", *TINY)
    assert done.returncode == 0, done.stderr
    model = artifact(tmp_path, "full")
    assert model["length"] == 2 and model["ranges"]["speed"] == [0.5, 1]


def test_data_without_straight_lines_names_the_label(fork, tmp_path):
    assert fork("01_make_dataset", "--out", tmp_path, "--trajectories", 1000, "--straight", 0).returncode == 0
    done = fork("02_train_wetvae", "--out", tmp_path, *TINY)
    assert one_line(done) and "0 of 1000 trajectories are of class 1 of curvature" in done.stderr


def test_rows_and_constants_of_ones_own(fork, tmp_path):
    """Edited in the files: TRAJECTORIES = 1e3, and a row with models that differ in their labels."""
    edits = {"01_make_dataset": ("TRAJECTORIES: Count = 100_000", "TRAJECTORIES: Count = 1e3"),
             "02_train_wetvae": ('MODELS = {  #', 'MODELS = {"mine": dict(BETA=2, LABELS="direction speed"), '
                                 '"mine_wide": dict(HIDDEN=8),  #'),
             "02_train_wetvae ": ('FIGURES = {  #', 'FIGURES = {"both": [("", "mine", 0), ("", "mine_wide", 3)],  #')}
    for name in ("common.py", "robots"):
        os.symlink(ROOT / name, tmp_path / name)
    for name, (old, new) in edits.items():
        path = tmp_path / f"{name.strip()}.py"
        source = (path if path.exists() else ROOT / path.name).read_text(encoding="utf-8")
        assert source.count(old) == 1
        path.write_text(source.replace(old, new), encoding="utf-8")
    for name, flags in (("01_make_dataset", ()), ("02_train_wetvae", ("--experiment", "both", "--epochs", 1, "--batch", 500))):
        done = fork(tmp_path / name, "--out", tmp_path, *flags)
        assert done.returncode == 0, done.stderr
    assert artifact(tmp_path, "mine")["names"] == ["speed", "direction"]
    wide = artifact(tmp_path, "mine_wide")
    assert wide["names"] == ["speed", "direction", "curvature"] and wide["config"]["HIDDEN"] == 8
    assert (tmp_path / "figures/both.png").exists() and len(rows_of(tmp_path)) == 5


@pytest.mark.parametrize("changed, words", [
    (dict(HIDEN=8), "HIDEN of model main is no constant in which models"),
    (dict(SEED=5), "SEED of model main is no constant in which"), (dict(THREADS=5), "THREADS of model main"),
    (dict(HIDDEN=0), "HIDDEN of model main is 0, but must be a whole number of at least 1"),
    (dict(EPOCHS=2.5), "EPOCHS of model main is 2.5, but must be a whole number"),
    (dict(GAMMA=-1), "GAMMA of model main is -1, but must be a number of at least 0")])
def test_a_model_that_makes_no_sense_is_one_line(s2, inside, out, changed, words):
    s2.MODELS["main"] = changed
    done = inside(s2, "--out", out)
    assert one_line(done) and words in done.stderr and not list(out.glob("*.pt")), done.stderr


@pytest.mark.parametrize("columns", [[("t", "b", 5)], [("a", "main")], ("", "main", 5), [("", "main", 5.0)], [("", "main", -1)]])
def test_columns_without_a_model_are_one_line_before_training(s2, inside, out, columns):
    s2.FIGURES["fig04_latent_traversals"] = columns
    done = inside(s2, "--out", out)
    assert one_line(done) and "must be (title, model, T)" in done.stderr and not list(out.glob("*.pt")), done.stderr


def test_other_classes_of_labels_draw_fig_9(s1, tmp_path, monkeypatch):
    monkeypatch.setattr("sys.argv", ["01_make_dataset.py", "--out", str(tmp_path), "--trajectories", "500"])
    monkeypatch.setattr(common, "CLASSES", common.CLASSES | dict(speed=2, direction=6))
    s1.main()
    assert (tmp_path / "figures/fig09_dataset.png").stat().st_size > 10_000


def test_without_a_relation_the_weight_is_nothing(s2):
    """All weights fit a decoder that does not turn, whatever curvature is asked for at speed 0."""
    decoder = ClosedForm(3, lambda z, steps: torch.zeros(len(z), steps, 2) + torch.tensor([1.0, 0.0]))
    assert s2.find_relation(decoder, ["speed", "direction", "curvature"], 5, 1.5) == dict(curvature=0)
