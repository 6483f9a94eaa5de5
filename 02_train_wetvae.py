"""Stage 2: trajectories -> WET-VAE: disentangled skills and their decoder (Sec. 4.1, App. A.1.2).

In: runs/dataset_*.npz of 01. Trains the WET-VAE (Eq. 4) and, to compare, the same model without labels (the
trajectory VAE); finds which latent is which factor, and the relation functions. Out, below runs/:
wetvae_<experiment>_seed<seed>.pt (and .._none), a figure and results/wetvae.csv.
Takes 35 s, 1.7 minutes with the trajectory VAE (one core). Expect purity 0.91, 0.91, 0.92, mean of 10 seeds.
"""
import hashlib
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
from common import (MULTI, Decoder, commands_of, cross_talk, factors_of, load, on_circle, parse_flags, plt,
                    save, save_figure, spread, stop, update_csv, weak_labels)

EXPERIMENT = "main"    # row of EXPERIMENTS below
SEED = 0               # random seed
OUT = "runs"           # folder of all that is written
TRAIN = True           # false: only measure and draw what is trained already
RESUME = False         # true: go on from the last checkpoint
THREADS = 2            # CPU threads

DATA = "main"          # experiment of 01 to train on
DATA_SEED = 0          # and its seed
LABELS = "speed direction curvature"  # the M factors of interest: a latent and a weak label y^m for each
LABELLED = True        # false: without the weak labels, the trajectory VAE (Co-Reyes et al. 2018)
OWN_AXIS = True        # p(y^m | z^m): label m is read from latent m, classes in order (false: from z, Eq. 4)
CIRCLE = False         # the latent of direction is an angle, for data of the full circle (the paper: no)

GAMMA = 10.0           # weight of the label cross-entropies, Eq. 4
BETA = 9.0             # weight of the KL divergence, Eq. 4
BETA_WARM_UP = 0.5     # share of the updates in which beta grows from 0; without it an axis can be lost
HIDDEN = 64            # width of every unit in Fig 1
BATCH = 512            # trajectories per update (the paper: 2048)
EPOCHS = 12            # passes over the data (the paper: 300)
LEARNING_RATE = 2e-3   # of Adam, falls linearly to 0 (the paper: 2e-4, fixed)

Z_RANGE = 1.5          # traversals are drawn (in training: relation functions found) from -Z_RANGE to Z_RANGE
FIGURE = ""            # name of the figure of traversals ("": traversals_<experiment>)
MODELS = {"": {}}      # models of an experiment: {end of the file's name: the constants that differ}
COLUMNS = []           # columns of its figure: title, model, T ([]: each model, at the T of the data)
# With the beta of the WET-VAE the latents of the trajectory VAE collapse (KL 0.000).
NONE = dict(LABELLED=False, GAMMA=0.0, BETA=1.0, BETA_WARM_UP=0.0, EPOCHS=24)
PRINTED = dict(OWN_AXIS=False, BETA_WARM_UP=0.0)  # Eq. 4 as printed; mixes axes with some seeds
EXPERIMENTS = {  # a row names the constants in which an experiment differs
    "main": dict(FIGURE="fig04_latent_traversals", MODELS={"": {}, "none": NONE}, COLUMNS=[
        ("(a) WET-VAE, T = 1", "", 1), ("(b) WET-VAE, T = 5", "", 5), ("(c) WET-VAE, T = 10", "", 10),
        ("(d) trajectory VAE, T = 5", "none", 5)]),
    "seeds": dict(MODELS={"": {}, "plain": PRINTED | dict(EPOCHS=24), "none": NONE}),
    "beta_gamma": PRINTED | dict(FIGURE="fig10_beta_gamma", MODELS={
        f"b{b}_g{g}": dict(BETA=b, GAMMA=g) for b, g in ((9, 0), (9, 1), (1, 10), (3, 10), (9, 10))}),
    "polar": dict(DATA="polar", LABELS="speed direction", FIGURE="fig11_polar_cartesian", MODELS={
        "": {}, "cartesian": dict(LABELS="x y"), "none": NONE | dict(LABELS="x y")}),
    "speed_acc": dict(DATA="speed_acc", LABELS="speed acceleration", EPOCHS=24, BETA=4.0, Z_RANGE=1.0,
                      FIGURE="fig12_speed_acceleration", MODELS={"": {}, "none": NONE}),
    "four_factors": dict(DATA="four_factors", LABELS="speed direction curvature acceleration", EPOCHS=60,
                         BETA=4.0, FIGURE="fig13_four_factors", MODELS={"": {}, "circle": dict(CIRCLE=True)}),
    "full": dict(DATA="full", FIGURE="full_circle_traversals", MODELS={"": {}, "circle": dict(CIRCLE=True)}),
}
FREE = {"OUT", "TRAIN", "RESUME", "THREADS", "Z_RANGE", "FIGURE"}  # change no network


class Encoder(nn.Module):
    """q_phi(z | tau, y), Fig 1 (the state decoder is common.Decoder): an LSTM over displacements and labels.
    circle: index of a latent that is an angle, a turn from -1.5 to 1.5. Its mean is the direction of two
    outputs: a single one would have to jump where the circle closes."""

    def __init__(self, x_dim, y_dim, z_dim, hidden, circle=None):
        super().__init__()
        self.z_dim, self.circle = z_dim, circle
        self.cell = nn.LSTMCell(x_dim + y_dim, hidden)  # in short loops faster than nn.LSTM
        outputs = 2 * z_dim + (circle is not None)
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, outputs))

    def forward(self, x, y):
        """x (B, T, x_dim), y (B, y_dim) one-hot labels side by side -> mean, log-variance (B, z_dim) each."""
        state = None
        for displacement in x.unbind(1):
            state = self.cell(torch.cat([displacement, y], 1), state)  # labels at each step, App. A.1.2
        out = self.head(state[0])
        mean, log_var = out[:, :self.z_dim], out[:, self.z_dim:2 * self.z_dim]
        if self.circle is not None:
            angle = torch.atan2(out[:, -1], mean[:, self.circle]) * 3 / (2 * math.pi)
            mean = torch.cat([mean[:, :self.circle], angle[:, None], mean[:, self.circle + 1:]], 1)
        return mean, log_var


class LabelDecoders(nn.Module):
    """p_theta(y^m | z), the M label decoders of Eq. 4: MLPs over all of z (the paper) or, with own_axis, the
    logits scale * z^m * order_k + bias_k of classes k. The order right, straight, left keeps straight
    in the middle. On a circle, classes lie at their true angles: this fixes direction 0."""

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
            self.order.append(torch.arange(0.0, sizes[m])[None])
            if name in MULTI:  # class 0, zero, lies between positive and negative
                self.order[m] = torch.tensor([[0.0, 1.0, -1.0]])
            if m == circle:  # the middle of each class
                self.order[m] = on_circle(1.5 - 3 / sizes[m] * (self.order[m][0] + 0.5)).T

    def forward(self, z):
        """z (B, z_dim) -> the logits of each label's classes: M tensors (B, classes)."""
        if not self.own_axis:
            return [head(z) for head in self.heads]
        read = [on_circle(z[:, m]) if m == self.circle else z[:, [m]] for m in range(len(self.order))]
        return [self.scale[m] * read[m] @ order + self.bias[m] for m, order in enumerate(self.order)]


# -------- the objective and its training, Eq. 4 and Alg. 1

def log_normal(x, mean, log_var):
    """log N(x; mean, exp(log_var)), elementwise. The trap: torch's gaussian_nll_loss bounds the variance."""
    return -0.5 * ((x - mean) ** 2 * torch.exp(-log_var) + log_var + math.log(2 * math.pi))


def divergence(mean, log_var, circle):
    """D_KL(q(z | tau, y) || p(z)) of each latent (B, z_dim). p is N(0, 1), of an angle uniform over the turn;
    q does not wrap, which makes the divergence too small by at most 0.1."""
    kl = 0.5 * (mean ** 2 + log_var.exp() - 1 - log_var)
    if circle is not None:
        entropy = 0.5 * (math.log(2 * math.pi * math.e) + log_var[:, circle])
        kl[:, circle] = torch.relu(math.log(3) - entropy)
    return kl


def objective(encoder, decoder, label_decoders, x, one_hot, y):
    """The three terms of Eq. 3 and 4: sums over time, dimensions and labels, means over the batch.
    x (B, T, x_dim) displacements; the labels as one_hot (B, y_dim), side by side, and as classes y (B, M)."""
    mean, log_var = encoder(x, one_hot)
    z = mean + torch.randn_like(mean) * (0.5 * log_var).exp()  # z ~ q(z | tau, y)
    # sum_t log p(s_t | s_1:t-1, z); in place of s_1:t-1 the decoder reads its own means
    states = log_normal(x, *decoder.unroll(z, x.shape[1])).sum((1, 2)).mean()
    logits = label_decoders(z)
    labels = -sum(F.cross_entropy(logits[m], y[:, m]) for m in range(len(logits)))  # sum_m log p(y^m | z)
    return states, labels, divergence(mean, log_var, decoder.circle).sum(1).mean()


def train(networks, data, variant, settings):
    """Alg. 1, "WET-VAE training", in place. networks: encoder, decoder, label decoders; data: x, one_hot and
    y of objective, for all N trajectories. Returns the seconds it took."""
    optimizer = torch.optim.Adam(networks.parameters(), fused=True)
    per_epoch, done, seconds = len(data[0]) // BATCH, 0, 0.0
    if RESUME and (Path(OUT) / common.artifact_name("wetvae-checkpoint", variant, SEED)).exists():
        state = load(OUT, "wetvae-checkpoint", variant, SEED, **settings)
        networks.load_state_dict(state["networks"])
        optimizer.load_state_dict(state["optimizer"])
        torch.set_rng_state(state["rng"])
        done, seconds = state["epoch"], state["seconds"]
    for epoch in range(done + 1, EPOCHS + 1):
        clock = time.time()
        for i, rows in enumerate(torch.randperm(len(data[0])).split(BATCH)[:per_epoch]):  # Alg. 1: B ~ D
            states, labels, kl = objective(*networks, *(part[rows] for part in data))
            progress = (epoch - 1 + i / per_epoch) / EPOCHS
            beta = BETA
            if progress < BETA_WARM_UP:
                beta *= progress / BETA_WARM_UP
            loss = -(states + GAMMA * labels - beta * kl)  # Eq. 4
            optimizer.param_groups[0]["lr"] = LEARNING_RATE * (1 - progress)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        seconds += time.time() - clock
        if not math.isfinite(loss.item()):
            stop(f"the loss of {variant} is {loss.item()} in epoch {epoch}, and nothing was overwritten; "
                 "lower --learning_rate", code=1)
        if epoch % 4 == 0 or epoch == EPOCHS:
            print(f"{epoch:3d}/{EPOCHS}  log p(tau|z) {states:7.3f}  log p(y|z) {labels:7.3f}  KL {kl:6.3f}  "
                  f"{seconds * (EPOCHS / epoch - 1):4.0f} s left", flush=True)
            save(OUT, "wetvae-checkpoint", variant, SEED, settings, networks=networks.state_dict(),
                 optimizer=optimizer.state_dict(), rng=torch.get_rng_state(), epoch=epoch, seconds=seconds)
    return seconds


@torch.no_grad()
def check_factors(decoder, names, steps):
    """Alg. 1, "Test: check factors in z", from the decoder alone: decodes samples of the prior, and matches
    latents with factors by the largest total |correlation|. Sets decoder.axes, the signed permutation after
    which axis m of z is factor m and + is more of it. Returns the |correlations| (M,)."""
    n = len(names)
    z = torch.randn(5000, n, generator=torch.Generator().manual_seed(0))
    if decoder.circle is not None:
        z[:, decoder.circle] = torch.linspace(-1.5, 1.5, len(z))
    found = list(factors_of(decoder.unroll(z, steps)[0].double().numpy(), names).values())
    with np.errstate(invalid="ignore", divide="ignore"):  # a factor that never changes has no correlation
        corr = np.nan_to_num(np.corrcoef(z.double().numpy().T, found)[:n, n:])  # latents x factors
    best = list(max(itertools.permutations(range(n)), key=lambda order: abs(corr[order, range(n)]).sum()))
    decoder.axes.zero_()
    decoder.axes[range(n), best] = torch.from_numpy(np.where(corr[best, range(n)] < 0, -1, 1)).float()
    return abs(corr[best, range(n)])


@torch.no_grad()
def find_relation(decoder, names, steps):
    """Alg. 1, "Test: find relation functions": for each factor of z_multi the weight with which single steps
    and the relation function (common.next_skill) come nearest to the decoder's free run of `steps` (RMS, as
    a share of the RMS step). Returns {factor: weight}."""
    grid, relation = torch.linspace(-Z_RANGE, Z_RANGE, 13), {}
    for factor in [name for name in names if MULTI.get(name) in names]:
        z = torch.zeros(len(grid) ** 2, len(names))  # direction 0: a turn stays within the data's directions
        z[:, [0, names.index(factor)]] = torch.cartesian_prod(grid, grid)  # the first axis is the speed
        free, errors = decoder(z, steps)[0], {}
        for weight in sorted(np.linspace(-1, 1, 401).round(4).tolist(), key=abs):  # small ones win ties
            skills = SimpleNamespace(method="wedis", decoder=decoder, names=names, relation={factor: weight})
            chain = commands_of(skills, z, steps)
            errors[weight] = ((chain - free).square().mean() / free.square().mean()).sqrt().item()
        best = relation[factor] = min(errors, key=errors.get)
        print(f"relation function of {factor}: weight {best:+.3f}, {errors[best]:.1%} from the decoder's "
              f"free run ({errors[0.0]:.1%} without it)")
    return relation


def weak_supervision(dataset, x, key, settings):
    """The factors of interest {name: (low, high)}, in the order of z in all stages, and the classes of their
    labels (N, M). Exits with 2 if the settings of model `key` do not fit the data."""
    globals().update(settings)  # as in main
    truth = dict(zip(dataset["names"].tolist(), dataset["factors"].T.astype(np.float64)))
    ranges = dict(zip(truth, dataset["ranges"].tolist()))
    if x.shape[2] == 2:
        truth |= factors_of(x.double().numpy(), ["x", "y"])
        ranges |= dict.fromkeys(("x", "y"), [-ranges["speed"][1], ranges["speed"][1]])
    asked = LABELS.split()
    if not asked or set(asked) - set(truth):
        stop(f"--labels {LABELS!r} must be factors of the data set {DATA!r}: {' '.join(truth)}")
    ranges = {name: ranges[name] for name in truth if name in asked}
    if len(x) < BATCH:
        stop(f"data set {DATA!r}: {len(x)} trajectories are fewer than --batch {BATCH}")
    circle = np.ptp(ranges.get("direction", [0])) > 6.28
    if CIRCLE and not (circle and LABELLED and OWN_AXIS):
        stop(f"model {key!r}: --circle true needs data of the full circle, direction in --labels, "
             "--labelled true and --own_axis true")
    y = weak_labels(truth, list(ranges), ranges)
    for m, name in enumerate(ranges):
        counts = np.bincount(y[:, m], minlength=common.CLASSES[name])
        if LABELLED and counts.min() < 0.005 * len(y):
            stop(f"label {name}: {counts.min()} of {len(y)} trajectories are of class {counts.argmin() + 1}; "
                 f"leave {name} out of --labels, or make other data with 01_make_dataset.py")
    return ranges, torch.from_numpy(y)


def main():
    config, given = parse_flags(globals())
    torch.set_num_threads(THREADS)
    models = {}
    if not MODELS or not all(len(column) == 3 and column[1] in MODELS for column in COLUMNS):
        stop(f"COLUMNS: each is (title, model, T), with a model of MODELS: {' '.join(MODELS)}")
    for key, changes in MODELS.items():
        for name, value in changes.items():
            if name not in config or name in FREE | {"EXPERIMENT", "SEED", "DATA", "DATA_SEED"}:
                stop(f"{name} of model {key!r} is no constant in which models of a row can differ")
            changes = changes | {name: common.convert(value, config[name], f"model {key!r}: {name}")}
        settings = config | changes | given  # flags override rows
        models[key] = {name: value for name, value in settings.items() if name not in FREE}
    if TRAIN:
        dataset = load(OUT, "dataset", DATA, DATA_SEED)
        x = torch.from_numpy(np.diff(dataset["trajectories"], axis=1))  # displacements, App. A.1.2
        supervision = {key: weak_supervision(dataset, x, key, models[key]) for key in models}

    trained = {}
    for key, settings in models.items():
        globals().update(settings)  # the constants of this model
        variant, weights = f"{EXPERIMENT}_{key}".strip("_"), f"beta {BETA:g}, gamma {GAMMA:g}"
        if TRAIN:
            ranges, y = supervision[key]
            names = list(ranges)
            labels = names if LABELLED else []
            print(f"\n{variant}, seed {SEED}, {weights}")
            torch.manual_seed(SEED)
            one_hot = [F.one_hot(y[:, m], common.CLASSES[name]).float() for m, name in enumerate(labels)]
            one_hot = torch.cat([torch.zeros(len(x), 0), *one_hot], 1)
            circle = names.index("direction") if CIRCLE else None
            encoder = Encoder(x.shape[2], one_hot.shape[1], len(names), HIDDEN, circle)
            decoder = Decoder(len(names), x.shape[2], HIDDEN, circle)
            heads = LabelDecoders(labels, len(names), HIDDEN, circle, OWN_AXIS)
            settings["DATASET"] = hashlib.sha256(x.numpy().tobytes()).hexdigest()  # other data, other model
            seconds = train(nn.ModuleList([encoder, decoder, heads]), (x, one_hot, y), variant, settings)
            abs_corr = check_factors(decoder, names, x.shape[1])  # Alg. 1, "Test"
            relation = find_relation(decoder, names, x.shape[1])  # Alg. 1, last line
            same = str(sorted(item for item in settings.items() if item[0] != "SEED"))  # rows of all seeds
            save(OUT, "wetvae", variant, SEED, settings, decoder=decoder, encoder=encoder.state_dict(),
                 names=names, ranges=ranges, relation=relation, length=x.shape[1], seconds=seconds,
                 abs_corr=abs_corr.tolist(), settings=hashlib.sha256(same.encode()).hexdigest()[:8])
        trained[key] = load(OUT, "wetvae", variant, SEED, **settings)
        kind = f"WET-VAE {key}" if LABELLED else "trajectory VAE"
        trained[key]["title"] = f"{kind}\n{weights}"
        measure(key or EXPERIMENT, trained[key])
    draw_traversals(trained)


# -------- measuring and drawing: not needed to understand the method

@torch.no_grad()
def traverse(decoder, axis, values, steps):
    """Displacements (len(values), steps, x_dim) decoded while one axis runs over values, the others at 0."""
    z = torch.zeros(len(values), len(decoder.axes))
    if decoder.x_dim == 1:
        z[:, 0] = -1.0  # but the speed in 1D: at 0 nothing can accelerate (Fig 12)
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    return decoder(z, steps)[0].double().numpy()


def measure(label, model):
    """Print what a model has learnt, and write a row per factor to results/wetvae.csv."""
    decoder, names = model["decoder"], model["names"]
    values, reach = np.linspace(-1.5, 1.5, 61), 3.0 if decoder.circle is None else 1.5
    curves = [factors_of(traverse(decoder, i, values, model["length"]), names) for i in range(len(names))]
    (C, purity), rows = cross_talk(curves, model["ranges"]), []
    same = dict(experiment=EXPERIMENT, seed=SEED, labels=label)
    for i, name in enumerate(names):
        curve = np.degrees(curves[i][name]) if name in ("direction", "curvature") else curves[i][name]
        row = dict(factor=name, abs_corr=model["abs_corr"][i], purity=purity[i],
                   crosstalk=", ".join(f"{other} {c:.2f}" for other, c in zip(names, C[i])),
                   range_low=curve.min(), range_high=curve.max(), largest_gap_deg="")
        if name == "direction" and np.ptp(model["ranges"][name]) > 6.28:  # empty angles, App. A.3.1
            first = traverse(decoder, i, np.linspace(-reach, reach, 3001), 1)  # a circle closes at 1.5
            first = first[np.linalg.norm(first[:, 0], axis=1) > 0.1]
            if len(first):
                row["largest_gap_deg"] = 360 - math.degrees(spread(factors_of(first, [name])[name], name))
        print(*(f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), sep="  ")
        if row["abs_corr"] < 0.5 or math.isnan(purity[i]):
            print(f"no latent means {name}: do not use z_{name}")
        rows.append(same | dict(beta=BETA, gamma=GAMMA) | row | dict(
            train_seconds=round(model["seconds"]), settings=model["settings"]))
    update_csv(Path(OUT) / "results" / "wetvae.csv", rows, (*same, "factor"))


def draw_traversals(trained):
    """Fig 4, 10 to 13: a row per axis, a column per (title, model, T). Lines have the colour of the latent;
    where they would hide one another, points have that of time, and the latent is on y."""
    columns = COLUMNS or [(model["title"], key, model["length"]) for key, model in trained.items()]
    names = max((model["names"] for model in trained.values()), key=len)
    heights = [0.5 if name in ("speed", "acceleration") else 1.0 for name in names]
    width = min(4.5, max(2.6, 9 / len(columns)))
    figure, axes = plt.subplots(len(names), len(columns), squeeze=False, height_ratios=heights,
                                figsize=(width * len(columns) + 0.9, 0.95 * width * sum(heights) + 0.8))
    values, dots, lines = np.linspace(-Z_RANGE, Z_RANGE, 13), None, None
    for j, (title, key, steps) in enumerate(columns):
        axes[0, j].set_title(title)
        axes[-1, j].set_xlabel("x (trajectory units)")
        for ax, (i, name) in zip(axes[:, j], enumerate(trained[key]["names"])):
            paths = traverse(trained[key]["decoder"], i, values, steps).cumsum(1)
            paths = np.pad(paths, ((0, 0), (1, 0), (0, 0)))
            ax.set_ylabel(f"z_{name}" if trained[key]["config"]["LABELLED"] else f"latent nearest {name}")
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
        bar = plt.cm.ScalarMappable(plt.Normalize(-Z_RANGE, Z_RANGE), "viridis")
        figure.colorbar(bar, ax=axes, label="value of the traversed latent (lines)", aspect=40)
    save_figure(figure, OUT, FIGURE or f"traversals_{EXPERIMENT}")


if __name__ == "__main__":
    main()
