"""Stage 2: trajectories -> WET-VAE: disentangled skills and their decoder (Sec. 4.1, App. A.1.2).

In: runs/dataset_*.npz of 01. Trains the WET-VAE (Eq. 4) and, to compare, the same model without labels (the
trajectory VAE), finds which latent is which factor, and the relation functions. Out, below runs/:
wetvae_<model>_seed<seed>.pt, a figure and results/wetvae.csv.
Takes 35 s, 1.7 minutes with the trajectory VAE (one core). Expect, mean of 10 seeds, for speed, direction and
curvature: purity 0.91, 0.91, 0.92; coverage of the factors' ranges 67, 74, 54 %.
"""
import itertools
import math
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

import common
from common import (MULTI, Count, Decoder, Positive, Share, commands_of, convert, cross_talk, digest, factors_of,
                    load, made_by, need_memory, on_circle, parse_flags, plt, save, save_figure, spread, stop,
                    types_of, update_csv, weak_labels)

EXPERIMENT: str = "fig04_latent_traversals"  # a figure of FIGURES (fig04 is enough) or a model of MODELS
SEED: int = 0                # random seed, of the data set too
OUT: str = "runs"            # folder of all that is written
TRAIN: bool = True           # false: only measure and draw what is trained already
THREADS: Count = 1           # CPU threads; a second one is no gain, and a loss on a busy machine

DATA: str = "main"           # experiment of 01 to train on
LABELS: str = "speed direction curvature"  # the M factors of interest: a latent, a weak label y^m for each
LABELLED: bool = True        # false: without weak labels, the trajectory VAE (Co-Reyes et al. 2018)
OWN_AXIS: bool = True        # p(y^m | z^m): label m is read from latent m alone (the paper: from all of z)
CIRCLE: bool = False         # the latent of direction is an angle, for data of the full circle (the paper: no)

GAMMA: float = 10.0          # weight of the label log-likelihoods, Eq. 4
BETA: float = 9.0            # weight of the KL divergence, Eq. 4
BETA_WARM_UP: Share = 0.5    # share of the updates in which beta grows from 0; without it an axis can be lost
HIDDEN: Count = 64           # width of every unit in Fig 1
BATCH: Count = 512           # trajectories per update (the paper: 2048)
EPOCHS: Count = 12           # passes over the data (the paper: 300)
LEARNING_RATE: Positive = 2e-3  # of Adam, falls linearly to 0 (the paper: 2e-4, fixed)
Z_RANGE: Positive = 1.5      # relation functions are found, traversals drawn from -Z_RANGE to Z_RANGE

# With the beta of the WET-VAE the latents of the trajectory VAE collapse (KL 0.000).
NONE = dict(LABELLED=False, GAMMA=0, BETA=1, BETA_WARM_UP=0, EPOCHS=24)
PRINTED = dict(OWN_AXIS=False, BETA_WARM_UP=0)  # Eq. 4 as printed; mixes axes with some seeds
POLAR = dict(DATA="polar", LABELS="speed direction")
LINE = dict(DATA="speed_acc", LABELS="speed acceleration", EPOCHS=24, BETA=4, Z_RANGE=1)
FOUR = dict(DATA="four_factors", LABELS="speed direction curvature acceleration", EPOCHS=60, BETA=4)
WEIGHTS = ((9, 0), (9, 1), (1, 10), (3, 10), (9, 10))  # beta and gamma of Fig 10
MODELS = {  # a row names the constants above in which a model differs
    "main": {}, "main_none": NONE,
    "full": dict(DATA="full"), "full_circle": dict(DATA="full", CIRCLE=True),
    "polar": POLAR, "polar_cartesian": POLAR | dict(LABELS="x y"), "polar_none": POLAR | NONE | dict(LABELS="x y"),
    "speed_acc": LINE, "speed_acc_none": LINE | NONE,
    "four_factors": FOUR, "four_factors_circle": FOUR | dict(CIRCLE=True),
    # Ten seeds, to find out what own axes and the warm-up of beta do: both, one of them, neither.
    "seeds": {}, "seeds_own_axis": dict(BETA_WARM_UP=0), "seeds_warm_up": dict(OWN_AXIS=False),
    "seeds_plain": PRINTED | dict(EPOCHS=24), "seeds_none": NONE,
} | {f"beta_gamma_b{beta}_g{gamma}": PRINTED | dict(BETA=beta, GAMMA=gamma) for beta, gamma in WEIGHTS}
FIGURES = {  # the columns of a figure: title ("": the model's name and weights), model, T (0: that of the data)
    "fig04_latent_traversals": [
        ("(a) WET-VAE, T = 1", "main", 1), ("(b) WET-VAE, T = 5", "main", 5), ("(c) WET-VAE, T = 10", "main", 10),
        ("(d) trajectory VAE, T = 5", "main_none", 5)],
    "fig10_beta_gamma": [("", f"beta_gamma_b{beta}_g{gamma}", 0) for beta, gamma in WEIGHTS],
    "fig11_polar_cartesian": [("", "polar", 0), ("", "polar_cartesian", 0), ("", "polar_none", 0)],
    "fig12_speed_acceleration": [("", "speed_acc", 0), ("", "speed_acc_none", 0)],
    "fig13_four_factors": [("", "four_factors", 0), ("", "four_factors_circle", 0)],
    "full_circle_traversals": [("", "full", 0), ("", "full_circle", 0)],
    "seeds_traversals": [("", name, 0) for name in MODELS if name.startswith("seeds")],
}


# -------- the networks of Fig 1; the state decoder p_theta(tau | z) is common.Decoder

class Encoder(nn.Module):
    """q_phi(z | tau, y): an LSTM reads a displacement and all labels at each step. Its last state gives a
    Gaussian over z. circle: index of a latent that is an angle, or None."""

    def __init__(self, x_dim, y_dim, z_dim, hidden, circle=None):
        super().__init__()
        self.z_dim, self.circle = z_dim, circle
        self.cell = nn.LSTMCell(x_dim + y_dim, hidden)  # in short loops faster than nn.LSTM
        outputs = 2 * z_dim + (circle is not None)  # the last one is for angle_mean
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs))

    def forward(self, x, y):
        """x (B, T, x_dim), y (B, y_dim) one-hot labels side by side -> mean, log-variance (B, z_dim) each."""
        state = None
        for displacement in x.unbind(1):
            state = self.cell(torch.cat([displacement, y], 1), state)  # labels at each step, App. A.1.2
        out = self.head(state[0])
        mean, log_var = out[:, :self.z_dim], out[:, self.z_dim:2 * self.z_dim]
        return angle_mean(mean, out[:, -1], self.circle), log_var


class LabelDecoders(nn.Module):
    """p_theta(y^m | z), the M label decoders of Eq. 4. own_axis false (the paper): MLPs over all of z. True:
    logits linear in z^m alone, scale * z^m * order_k + bias_k for class k, so that the classes lie in their
    order along the latent."""

    def __init__(self, labels, z_dim, hidden, circle, own_axis):
        super().__init__()
        self.circle, self.own_axis, self.order = circle, own_axis, []
        sizes = [common.CLASSES[name] for name in labels]
        if own_axis:
            self.scale = nn.Parameter(torch.full((len(labels),), 3.0))
            self.bias = nn.ParameterList(torch.zeros(size) for size in sizes)
        else:
            self.heads = nn.ModuleList(
                nn.Sequential(nn.Linear(z_dim, hidden), nn.ReLU(), nn.Linear(hidden, size)) for size in sizes)
        for m, name in enumerate(labels):
            order = torch.arange(0.0, sizes[m])[None]
            if name in MULTI:  # the classes are zero, positive, negative: zero lies in the middle
                order = torch.tensor([[0.0, 1.0, -1.0]])
            self.order.append(angle_order(sizes[m]) if m == circle else order)

    def forward(self, z):
        """z (B, z_dim) -> the logits of each label's classes: M tensors (B, classes)."""
        if not self.own_axis:
            return [head(z) for head in self.heads]
        logits = []
        for m, order in enumerate(self.order):
            read = on_circle(z[:, m]) if m == self.circle else z[:, [m]]
            logits.append(self.scale[m] * read @ order + self.bias[m])
        return logits


# -------- the objective, Eq. 3 and 4

def log_normal(x, mean, log_var):
    """log N(x; mean, exp(log_var)), elementwise. The trap: torch's gaussian_nll_loss bounds the variance."""
    return -0.5 * ((x - mean) ** 2 * torch.exp(-log_var) + log_var + math.log(2 * math.pi))


def divergence(mean, log_var, circle):
    """D_KL(q(z | tau, y) || p(z)) of each latent, (B, z_dim). The prior p(z) is N(0, 1)."""
    kl = 0.5 * (mean ** 2 + log_var.exp() - 1 - log_var)
    return angle_divergence(kl, log_var, circle)


def objective(encoder, decoder, label_decoders, x, one_hot, y):
    """The three terms of Eq. 3 and 4: sums over time, dimensions and labels, means over the batch.
    x (B, T, x_dim) displacements; the labels as one_hot (B, y_dim), side by side, and as classes y (B, M)."""
    mean, log_var = encoder(x, one_hot)
    z = mean + torch.randn_like(mean) * (0.5 * log_var).exp()  # z ~ q(z | tau, y)
    # sum_t log p(s_t | s_1:t-1, z). The trap: the decoder reads its own means in place of s_1:t-1.
    states = log_normal(x, *decoder.decode_latents(z, x.shape[1])).sum((1, 2)).mean()
    logits = label_decoders(z)
    labels = -sum(F.cross_entropy(logits[m], y[:, m]) for m in range(len(logits)))  # sum_m log p(y^m | z)
    return states, labels, divergence(mean, log_var, decoder.circle).sum(1).mean()


# -------- Alg. 1, the first loop

def supervision(dataset, hyper):
    """What 01 has generated, as the WET-VAE reads it: displacements x (N, T, x_dim), App. A.1.2; the factors
    of interest {name: (low, high)}, whose order is that of z in all stages; classes y (N, M) of their labels."""
    x = np.diff(dataset["trajectories"], axis=1)
    factors = dict(zip(dataset["names"].tolist(), dataset["factors"].T.astype(np.float64)))
    ranges = dict(zip(factors, dataset["ranges"].tolist()))
    if x.shape[2] == 2:  # Cartesian factors, Fig 11
        factors |= factors_of(x.astype(np.float64), ["x", "y"])
        ranges |= dict.fromkeys(("x", "y"), [-ranges["speed"][1], ranges["speed"][1]])
    ranges = {name: ranges[name] for name in factors if name in hyper.labels.split()}
    y = weak_labels(factors, list(ranges), ranges)  # Alg. 1, "Compute labels"
    return torch.from_numpy(x), ranges, torch.from_numpy(y)


def one_hot_labels(y, labels):
    """Classes y (N, M) -> one-hot vectors side by side, (N, y_dim). Without labels y_dim is 0."""
    parts = [F.one_hot(y[:, m], common.CLASSES[name]).float() for m, name in enumerate(labels)]
    return torch.cat([torch.zeros(len(y), 0), *parts], 1)


def train(x, y, names, hyper):
    """Alg. 1, "WET-VAE training". x (N, T, x_dim), y (N, M), the names of the M factors. hyper: the
    hyperparameters, for each constant of MODELS a field with its name. Returns encoder and decoder."""
    labels = names if hyper.labelled else []
    one_hot = one_hot_labels(y, labels)
    circle = names.index("direction") if hyper.circle else None
    encoder = Encoder(x.shape[2], one_hot.shape[1], len(names), hyper.hidden, circle)
    decoder = Decoder(len(names), x.shape[2], hyper.hidden, circle)
    label_decoders = LabelDecoders(labels, len(names), hyper.hidden, circle, hyper.own_axis)
    networks = nn.ModuleList([encoder, decoder, label_decoders])
    optimizer = torch.optim.Adam(networks.parameters(), fused=True)

    updates = len(x) // hyper.batch  # of an epoch
    for epoch in range(hyper.epochs):
        batches = torch.randperm(len(x)).split(hyper.batch)[:updates]
        for i, rows in enumerate(batches):  # Alg. 1: B ~ D
            states, labels, kl = objective(*networks, x[rows], one_hot[rows], y[rows])
            progress = (epoch + i / updates) / hyper.epochs
            beta = hyper.beta
            if progress < hyper.beta_warm_up:
                beta *= progress / hyper.beta_warm_up
            loss = -(states + hyper.gamma * labels - beta * kl)  # Eq. 4
            optimizer.param_groups[0]["lr"] = hyper.learning_rate * (1 - progress)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        report(epoch + 1, hyper.epochs, states, labels, kl)
    return encoder, decoder


# -------- Alg. 1, the two lines "Test"

@torch.no_grad()
def check_factors(decoder, names, steps):
    """Alg. 1, "Test: check factors in z", from the decoder alone: decodes samples of the prior, and matches
    latents with factors by the largest total |correlation|. Sets decoder.axes, the signed permutation after
    which axis m of z is factor m and + is more of it. Returns the |correlations| (M,)."""
    n = len(names)
    latents = torch.randn(5000, n, generator=torch.Generator().manual_seed(0))
    latents = angle_prior(latents, decoder.circle)
    found = list(factors_of(decoder.decode_latents(latents, steps)[0].double().numpy(), names).values())
    with np.errstate(invalid="ignore", divide="ignore"):  # a factor that never changes has no correlation
        corr = np.nan_to_num(np.corrcoef(latents.double().numpy().T, found)[:n, n:])  # latents x factors
    best = list(max(itertools.permutations(range(n)), key=lambda order: abs(corr[order, range(n)]).sum()))
    decoder.axes.zero_()
    decoder.axes[range(n), best] = torch.from_numpy(np.where(corr[best, range(n)] < 0, -1, 1)).float()
    return abs(corr[best, range(n)])


@torch.no_grad()
def find_relation(decoder, names, steps, z_range):
    """Alg. 1, "Test: find relation functions": for each factor of z_multi the weight with which single steps
    and the relation function (common.next_skill) come nearest to the decoder's free run of `steps` (RMS, as
    a share of the RMS step), over a grid from -z_range to z_range. Returns {factor: weight}."""
    grid, relation = torch.linspace(-z_range, z_range, 13), {}
    for factor in [name for name in names if MULTI.get(name) in names]:
        z = torch.zeros(len(grid) ** 2, len(names))  # direction 0: a turn stays within the data's directions
        z[:, [0, names.index(factor)]] = torch.cartesian_prod(grid, grid)  # the first axis is the speed
        free_run, errors = decoder(z, steps)[0], {}
        for weight in sorted(np.linspace(-1, 1, 401).round(4).tolist(), key=abs):  # small ones win ties
            skills = SimpleNamespace(method="wedis", decoder=decoder, names=names, relation={factor: weight})
            chain = commands_of(skills, z, steps)
            errors[weight] = ((chain - free_run).square().mean() / free_run.square().mean()).sqrt().item()
        best = relation[factor] = min(errors, key=errors.get)
        print(f"relation function of {factor}: weight {best:+.3f}, {errors[best]:.1%} from the decoder's "
              f"free run ({errors[0.0]:.1%} without it)")
    return relation


# -------- the circle: a latent that is an angle, of which 3 is a whole turn (not in the paper; common.on_circle)

def angle_mean(mean, last, circle):
    """Means (B, z_dim) of the encoder, in which the angle is the direction of two outputs, its own and the
    last (B,). The trap: a single output would have to jump where the circle closes."""
    if circle is None:
        return mean
    angle = torch.atan2(last, mean[:, circle]) * 3 / (2 * math.pi)
    return torch.cat([mean[:, :circle], angle[:, None], mean[:, circle + 1:]], 1)


def angle_order(classes):
    """For LabelDecoders: the middles of the direction's classes, which are at their true angles, (2, classes).
    This fixes where direction 0 is."""
    return on_circle(1.5 - 3 / classes * (torch.arange(0.0, classes) + 0.5)).T


def angle_divergence(kl, log_var, circle):
    """The divergences (B, z_dim), in which the angle's prior is uniform over the turn. q does not wrap, which
    makes the divergence too small by at most 0.1."""
    if circle is not None:
        entropy = 0.5 * (math.log(2 * math.pi * math.e) + log_var[:, circle])
        kl[:, circle] = torch.relu(math.log(3) - entropy)
    return kl


def angle_prior(latents, circle):
    """Samples of N(0, 1) (B, z_dim), in which the angle goes once round the circle."""
    if circle is not None:
        latents[:, circle] = torch.linspace(-1.5, 1.5, len(latents))
    return latents


# ======== not needed to understand the method

def main():
    config, given = parse_flags(globals())
    torch.set_num_threads(THREADS)
    figure, columns = columns_of(EXPERIMENT)
    models = {column[-2]: hyperparameters(column[-2], config, given) for column in columns}
    needed = dict.fromkeys(hyper.data for hyper in models.values() if TRAIN)
    datasets = {name: load(OUT, "dataset", name, SEED) for name in needed}
    check(columns, models, datasets)

    trained = {}
    for name, hyper in models.items():
        constants = {field.upper(): value for field, value in vars(hyper).items()}
        if TRAIN:
            print(f"\n{name}, seed {SEED}, beta {hyper.beta:g}, gamma {hyper.gamma:g}")
            x, ranges, y = supervision(datasets[hyper.data], hyper)
            names, steps, clock = list(ranges), x.shape[1], time.time()
            torch.manual_seed(SEED)
            encoder, decoder = train(x, y, names, hyper)
            seconds = time.time() - clock
            abs_corr = check_factors(decoder, names, steps).tolist()
            relation = find_relation(decoder, names, steps, hyper.z_range)
            made = datasets[hyper.data]["config"].items()
            made = {key: value for key, value in made if key not in ("SEED", "OUT", "FIGURE")}
            settings = constants | dict(DATASET=digest(made))  # the same for all seeds
            save(OUT, "wetvae", name, SEED, settings | dict(SEED=SEED), decoder=decoder,
                 encoder=encoder.state_dict(), names=names, ranges=ranges, relation=relation, length=steps,
                 seconds=seconds, abs_corr=abs_corr, settings=digest(made_by(settings)))
            if hyper.labelled and names == ["speed", "direction", "curvature"]:
                follow_one_skill(encoder, decoder, ranges, steps)
        trained[name] = load(OUT, "wetvae", name, SEED, **constants, CLASSES=common.CLASSES)
        measure(name, hyper, trained[name])
    draw_traversals(trained, columns, figure)


def columns_of(experiment):
    """The name of a figure and its columns: a figure of FIGURES, for which a part of its name is enough, or
    the traversals of a single model. Without columns if there is neither."""
    if experiment in MODELS:
        return f"traversals_{experiment}", [("", experiment, 0)]
    found = [experiment] if experiment in FIGURES else [name for name in FIGURES if experiment in name]
    return (found[0], FIGURES[found[0]]) if len(found) == 1 else ("", [])


def hyperparameters(name, config, given):
    """The constants with which a model is trained, as fields in lower case: its row overrides the file, a
    flag that was given both. The first five constants describe the run and not the model."""
    kinds, values = types_of(globals()), config | MODELS.get(name, {}) | given
    own = [constant for constant in kinds if constant not in ("EXPERIMENT", "SEED", "OUT", "TRAIN", "THREADS")]
    return SimpleNamespace(**{constant.lower(): convert(values[constant], kinds[constant], f"{constant} of {name}")
                              for constant in own})


def check(columns, models, datasets):
    """End with one line, before any training, if rows name what is not there, or data and model do not fit."""
    if not columns:
        stop(f"unknown experiment {EXPERIMENT!r}; allowed: {' '.join([*FIGURES, *MODELS])}")
    for column in columns:
        if len(column) != 3 or column[1] not in MODELS or not isinstance(column[2], int) or column[2] < 0:
            stop(f"{column} in FIGURES must be (title, model, T) with a model of MODELS: {' '.join(MODELS)}")
    for name, hyper in models.items():
        if unknown := [constant for constant in MODELS[name] if constant.lower() not in vars(hyper)]:
            stop(f"{unknown[0]} of model {name} is no constant in which models can differ")
    for name, hyper in models.items() if datasets else ():
        dataset = datasets[hyper.data]
        make = f"python 01_make_dataset.py --seed {SEED} --experiment {hyper.data}"
        known = dataset["names"].tolist() + ["x", "y"] * (dataset["trajectories"].shape[2] == 2)
        if not hyper.labels or set(hyper.labels.split()) - set(known):
            stop(f"model {name}: --labels {hyper.labels!r} must be factors of the data set {hyper.data}, which are: "
                 f"{' '.join(known)}")
        x, ranges, y = supervision(dataset, hyper)
        if len(x) < hyper.batch:
            stop(f"the {len(x)} trajectories of the data set {hyper.data} are fewer than --batch {hyper.batch}: "
                 f"lower --batch, or make more with: {make}")
        need_memory(160 * hyper.hidden ** 2, "--hidden")
        degrees = math.degrees(np.ptp(ranges.get("direction", [0, 0])))
        if hyper.circle and not (degrees > 359 and hyper.labelled and hyper.own_axis):
            stop(f"model {name}: --circle true needs data of the full circle, direction in --labels (here it covers "
                 f"{degrees:.0f} degrees), --labelled true and --own_axis true, as in --experiment full_circle")
        for m, factor in enumerate(ranges if hyper.labelled else ()):
            classes = common.CLASSES[factor]
            counts = np.bincount(y[:, m], minlength=classes)
            mend = f"make more trajectories with: {make}"
            if factor in MULTI:
                mend = f"the three classes are zero, positive, negative; try: {make} --straight 0.2"
            if factor in ("x", "y"):
                mend = "these labels need data of the full circle, as in --experiment polar_cartesian"
            if len(counts) != classes or counts.min() < 0.005 * len(y):
                stop(f"model {name}: {counts.min()} of {len(y)} trajectories are of class {counts.argmin() + 1} of the "
                     f"{classes} of {factor} (CLASSES in common.py): {mend}, or leave {factor} out of --labels")


def report(epoch, epochs, states, labels, kl):
    """Print the terms of Eq. 4 every four epochs. End if one is not finite: nothing was written then."""
    if not math.isfinite(states + labels + kl):
        stop(f"the loss is not finite in epoch {epoch}, and nothing was overwritten; lower --learning_rate", code=1)
    if epoch % 4 == 0 or epoch == epochs:
        print(f"{epoch:3d}/{epochs}  log p(tau|z) {states:7.3f}  log p(y|z) {labels:7.3f}  KL {kl:6.3f}", flush=True)


# -------- measuring and drawing

@torch.no_grad()
def follow_one_skill(encoder, decoder, ranges, steps):
    """Print what the model makes of the example that all four scripts follow."""
    factors = dict(speed=np.array([0.6]), direction=np.radians([20.0]), curvature=np.radians([-10.0]))
    heading = factors["direction"] + factors["curvature"] * np.arange(steps)
    x = torch.from_numpy(0.6 * np.stack([np.cos(heading), np.sin(heading)], 1)).float()
    y = torch.from_numpy(weak_labels(factors, list(ranges), ranges))
    mean, _ = encoder(x[None], one_hot_labels(y, list(ranges)))
    z = mean @ decoder.axes.T  # latents to canonical axes: the inverse of what Decoder.forward does
    decoded = decoder(z, steps)[0][0]
    print("One skill: the trajectory with speed 0.6, direction 20 degrees, curvature -10 degrees")
    print("encoder: z = (" + ", ".join(f"{name} {value:+.2f}" for name, value in zip(ranges, z[0])) + ")")
    for text, rows in (("its true displacements:  ", x), ("the decoder's, from z:   ", decoded)):
        print(text + " ".join(f"({dx:+.2f}, {dy:+.2f})" for dx, dy in rows[:5]))
    ends = [f"({end[0]:.2f}, {end[1]:.2f})" for end in (x.sum(0), decoded.sum(0))]
    print(f"after {steps} transitions: true end {ends[0]}, decoded end {ends[1]}, in trajectory units")


@torch.no_grad()
def traverse(decoder, axis, values, steps):
    """Displacements (len(values), steps, x_dim) decoded while one axis runs over values, the others at 0."""
    z = torch.zeros(len(values), len(decoder.axes))
    if decoder.x_dim == 1:
        z[:, 0] = -1.0  # but the speed in 1D: at 0 nothing can accelerate (Fig 12)
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    return decoder(z, steps)[0].double().numpy()


def measure(name, hyper, model):
    """Print what a model has learnt, and write a row per factor to results/wetvae.csv."""
    decoder, names = model["decoder"], model["names"]
    values, reach = np.linspace(-1.5, 1.5, 61), 3.0 if decoder.circle is None else 1.5
    curves = [factors_of(traverse(decoder, i, values, model["length"]), names) for i in range(len(names))]
    (C, purity), rows = cross_talk(curves, model["ranges"]), []
    group = max((other for other in [*MODELS, "beta_gamma"] if name.startswith(f"{other}_")), key=len, default=name)
    same = dict(experiment=group, seed=SEED, labels=name.removeprefix(f"{group}_"))
    for i, factor in enumerate(names):
        curve = np.degrees(curves[i][factor]) if factor in ("direction", "curvature") else curves[i][factor]
        row = dict(factor=factor, abs_corr=model["abs_corr"][i], purity=purity[i],
                   crosstalk=", ".join(f"{other} {c:.2f}" for other, c in zip(names, C[i])),
                   range_low=curve.min(), range_high=curve.max(), largest_gap_deg="")
        if factor == "direction" and np.ptp(model["ranges"][factor]) > 6.28:  # empty angles, App. A.3.1
            first = traverse(decoder, i, np.linspace(-reach, reach, 3001), 1)  # a circle closes at 1.5
            first = first[np.linalg.norm(first[:, 0], axis=1) > 0.1]
            if len(first):
                row["largest_gap_deg"] = 360 - math.degrees(spread(factors_of(first, [factor])[factor], factor))
        print(*(f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), sep="  ")
        if row["abs_corr"] < 0.5 or math.isnan(purity[i]):
            print(f"no latent means {factor}: do not use z_{factor}")
        rows.append(same | dict(beta=hyper.beta, gamma=hyper.gamma) | row | dict(
            train_seconds=round(model["seconds"]), settings=model["settings"]))
    update_csv(Path(OUT) / "results" / "wetvae.csv", rows, (*same, "factor", "settings"))


def draw_traversals(trained, columns, figure_name):
    """Fig 4, 10 to 13: a row per axis, a column per (title, model, T). Lines have the colour of the latent;
    where they would hide one another, points have that of time, and the latent is on y."""
    names = max((model["names"] for model in trained.values()), key=len)
    heights = [0.5 if name in ("speed", "acceleration") else 1.0 for name in names]
    width = min(4.5, max(2.6, 9 / len(columns)))
    figure, axes = plt.subplots(len(names), len(columns), squeeze=False, height_ratios=heights,
                                figsize=(width * len(columns) + 0.9, 0.95 * width * sum(heights) + 0.8))
    reach, dots, lines = max(model["config"]["Z_RANGE"] for model in trained.values()), None, None
    values = np.linspace(-reach, reach, 13)
    for j, (title, key, steps) in enumerate(columns):
        model, steps = trained[key], steps or trained[key]["length"]
        weights = "beta {BETA:g}, gamma {GAMMA:g}".format(**model["config"])
        axes[0, j].set_title(title or f"{key}\n{weights}")
        axes[-1, j].set_xlabel("x (trajectory units)")
        for ax, (i, name) in zip(axes[:, j], enumerate(model["names"])):
            paths = traverse(model["decoder"], i, values, steps).cumsum(1)
            paths = np.pad(paths, ((0, 0), (1, 0), (0, 0)))
            ax.set_ylabel(f"z_{name}" if model["config"]["LABELLED"] else f"latent nearest {name}")
            if paths.shape[2] == 1 or name == "acceleration":
                value, t = np.meshgrid(values, range(steps + 1), indexing="ij")
                dots = ax.scatter(paths[..., 0], value, s=8, c=t, cmap="plasma")
            else:
                for path, colour in zip(paths, plt.get_cmap("viridis")(np.linspace(0, 0.95, 13))):
                    lines = ax.plot(*path.T, ".-", ms=3, lw=1, color=colour)
                ax.set_aspect("equal", "datalim")
    if dots:
        figure.legend(*dots.legend_elements(fmt="t = {x:g}"), loc="outside lower center", ncols=9)
    if lines:
        bar = plt.cm.ScalarMappable(plt.Normalize(-reach, reach), "viridis")
        figure.colorbar(bar, ax=axes, label="value of the traversed latent (lines)", aspect=40)
    save_figure(figure, OUT, figure_name)


if __name__ == "__main__":
    main()
