"""Stage 2: trajectories -> WET-VAE: disentangled skills and the decoder that predicts them (Sec. 4.1, App. A.1.2).

Reads runs/dataset_*.npz. Trains the WET-VAE (Eq. 4) and, for comparison, the same model without labels (the trajectory
VAE), finds which latent is which factor, and writes runs/wetvae_<experiment>_seed<seed>.pt (and <experiment>_none),
its figure, results/wetvae.csv and results/crosstalk.csv. Takes 70 seconds on one core, 3.4 minutes with the
trajectory VAE (AMD EPYC 7003, no AVX-512). Expect, n = 10 seeds: purity 0.91, 0.91, 0.92, the worst 0.88; |corr| 0.98, 0.98, 0.90.
"""
import itertools
import math
import time
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.nn import functional as F

import common
from common import (LABEL_RULES, Decoder, artifact_name, bootstrap_interval, check_same, cross_talk, factors_of,
                    load, load_decoder, parse_flags, plt, read_csv, resumable, save, save_figure, spread, stop, update_csv, weak_labels)

EXPERIMENT = "main"    # row of EXPERIMENTS below
SEED = 0               # random seed
OUT = "."              # folder for runs/, figures/ and results/
TRAIN = True           # false: only draw and measure what is already trained
RESUME = False         # true: continue from the last checkpoint
CHECKPOINT = 1.0       # minutes between checkpoints

DATA = "main"          # experiment of 01 to train on
DATA_SEED = 0          # and its seed
LABELS = "speed direction curvature"  # weak labels y^m, names of LABEL_RULES
FACTORS = ""           # factors that latents are matched with and measured on ("": the data's); several sets between commas
BASE = "0 0 0 0"       # value of each axis while another one is traversed
CIRCLE = False         # direction as a pair of latents on the unit circle: no empty angles (the paper: one Gaussian axis)
BASELINE = True        # also train the trajectory VAE, the same model without labels

BETA = 9.0             # weight of the KL divergence, Eq. 4
BASELINE_BETA = 1.0    # of the trajectory VAE: at 9 its latent collapses (KL 0.000), which would make a straw man of it
BETA_WARM_UP = 0.5     # share of the updates over which beta grows from 0: at once, hard data sets lose an axis for good
OWN_AXIS = True        # p(y^m | z^m): label m is read from latent m alone, its classes in order on it (false: from all of z, as Eq. 4 is printed)
GAMMA = 10.0           # weight of the label cross-entropies, Eq. 4
HIDDEN = 64            # width of every unit in Fig 1
BATCH = 512            # trajectories per update (the paper: 2048)
EPOCHS = 12            # the paper: 300
BASELINE_EPOCHS = 24   # of the trajectory VAE
LEARNING_RATE = 2e-3   # Adam, decays linearly to 0 (the paper: 2e-4, fixed)
HELD_OUT = 5000        # trajectories kept for |corr|, MIG and SAP
THREADS = 2            # CPU threads

FIGURE = ""            # name of the figure drawn
MODELS, COLUMNS = {"": {}}, ()
BETA_GAMMA = ((9, 0), (9, 1), (1, 10), (3, 10), (9, 10))  # of Fig 10
PLAIN = dict(OWN_AXIS=False, BETA_WARM_UP=0.0, EPOCHS=24)  # Eq. 4 as printed; needs twice the epochs, and mixes axes with some seeds
NONE = dict(LABELS="", GAMMA=0.0, BETA_WARM_UP=0.0)  # the trajectory VAE; with BASELINE_BETA and BASELINE_EPOCHS
EXPERIMENTS = {  # a row names the constants in which an experiment differs from the ones above; MODELS: the same for each model it
    # trains (end of the file's name and what differs); COLUMNS of its figure: title, model, T
    "main": dict(MODELS={"": {}, "none": NONE}, FIGURE="fig04_latent_traversals", COLUMNS=[
        ("(a) WET-VAE, T = 1", "main", 1), ("(b) WET-VAE, T = 5", "main", 5), ("(c) WET-VAE, T = 10", "main", 10),
        ("(d) trajectory VAE, T = 5", "main_none", 5)]),
    "seeds": dict(MODELS={"": {}, "plain": PLAIN, "none": NONE}, FIGURE="seeds_wetvae"),
    "beta_gamma": PLAIN | dict(EPOCHS=12, FIGURE="fig10_beta_gamma",
                               MODELS={f"b{b}_g{g}": dict(BETA=float(b), GAMMA=float(g)) for b, g in BETA_GAMMA},
                               COLUMNS=[(f"({c}) β = {b}, γ = {g}", f"beta_gamma_b{b}_g{g}", 5) for c, (b, g) in zip("abcde", BETA_GAMMA)]),
    "polar": dict(DATA="polar", LABELS="speed angle", MODELS={"": {}, "none": NONE | dict(FACTORS="speed direction, x y")}),
    "cartesian": dict(DATA="polar", LABELS="x y", FACTORS="x y", FIGURE="fig11_polar_cartesian", COLUMNS=[
        ("polar labels", "polar", 5), ("Cartesian labels", "cartesian", 5), ("no labels", "polar_none", 5)]),
    "speed_acc": dict(EPOCHS=24, BETA=4.0, DATA="speed_acc", LABELS="velocity acceleration", BASE="-1 0", MODELS={"": {}, "none": NONE},
                      FIGURE="fig12_speed_acceleration", COLUMNS=[("WET-VAE", "speed_acc", 5), ("no labels", "speed_acc_none", 5)]),
    "four_factors": dict(
        EPOCHS=60, BETA=4.0, DATA="four_factors", LABELS="speed angle curvature acceleration", MODELS={"": {}, "circle": dict(CIRCLE=True)},
        FIGURE="fig13_four_factors", COLUMNS=[("Gaussian axis", "four_factors", 5), ("circle", "four_factors_circle", 5)]),
    "full": dict(
        DATA="full", LABELS="speed angle curvature", MODELS={"": {}, "circle": dict(CIRCLE=True)},
        FIGURE="full_circle_traversals", COLUMNS=[("Gaussian axis", "full", 5), ("circle", "full_circle", 5)]),
}


class Encoder(nn.Module):
    """q_phi(z | tau, y), Fig 1: an LSTM over displacements and one-hot labels; its last state gives mean and log-variance."""

    def __init__(self, x_dim, y_dim, z_dim):
        super().__init__()
        self.cell = nn.LSTMCell(x_dim + y_dim, HIDDEN)  # five steps of a cell are twice as fast here as nn.LSTM
        self.head = nn.Sequential(nn.Linear(HIDDEN, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 2 * z_dim))

    def forward(self, x, y):
        """x (B, T, x_dim), y (B, y_dim) one-hot labels side by side -> mean, log-variance (B, z_dim) each."""
        state = None
        for displacement in x.unbind(1):
            state = self.cell(torch.cat([displacement, y], 1), state)  # the labels are read at every step, App. A.1.2
        return self.head(state[0]).chunk(2, 1)


def sample(mean, log_var, circle):
    """Reparameterised latents (B, L) and D_KL(q || prior) of each (B, L). circle: the first two are a point at an angle whose mean is the
    direction of mean[:, :2], with noise of one standard deviation, against a uniform prior: no ends and no middle. Its KL takes the
    noise for unwrapped (0.1 nats too little at most)."""
    z = mean + torch.randn_like(mean) * (0.5 * log_var).exp()
    kl = 0.5 * (mean ** 2 + log_var.exp() - 1 - log_var)
    if circle:
        angle = torch.atan2(mean[:, 1], mean[:, 0]) + (z - mean)[:, 0]
        z = torch.cat([angle.cos()[:, None], angle.sin()[:, None], z[:, 2:]], 1)
        kl = torch.cat([torch.relu(0.5 * (math.log(2 * math.pi) - 1 - log_var[:, :1])), kl[:, 2:]], 1)
    return z, kl


def gaussian_log_prob(x, mean, log_var):
    """log N(x; mean, exp(log_var)), elementwise."""
    return -0.5 * ((x - mean) ** 2 * torch.exp(-log_var) + log_var + math.log(2 * math.pi))


class Ordered(nn.Module):
    """p(y^m | z^m) of a label whose classes follow one another along its axis (softmax of lines with slopes in that order) or round its
    circle (of cosines). Without the order classes settle in any: straight at one end of curvature, left and right side by side."""

    def __init__(self, classes, circle):
        super().__init__()
        turns = torch.arange(classes) * (2 * math.pi / classes)
        order = [0, 1, -1] if classes == 3 else range(classes)  # straight lies between left and right, none between up and down
        self.register_buffer("order", torch.stack([turns.cos(), turns.sin()]) if circle else torch.tensor([list(order)], dtype=torch.float32))
        self.scale, self.bias = nn.Parameter(torch.tensor(3.0)), nn.Parameter(torch.zeros(classes))

    def forward(self, z):
        return self.scale * z @ self.order + self.bias


def label_decoders(labels, z_dim, circle, own_axis):
    """p(y^m | .) of each label and the part of z it reads: all of it, or with own_axis its own latent (an angle's circle: the first two)."""
    heads, parts, rest = [], [], iter(range(2 * circle, z_dim))
    for name in labels:
        classes, closed = LABEL_RULES[name][0], circle and name == "angle"
        if own_axis:
            parts.append(slice(0, 2) if closed else slice(m := next(rest), m + 1))
            heads.append(Ordered(classes, closed))
        else:
            parts.append(slice(None))
            heads.append(nn.Sequential(nn.Linear(z_dim, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, classes)))
    return nn.ModuleList(heads), parts


def objective(encoder, decoder, classifiers, parts, x, y, sizes):
    """The three terms of Eq. 4: sum_t log p(s_t | s_<t, z), sum_m log p(y^m | z), D_KL(q(z | tau, y) || N(0, 1)). Sums over
    time, dimensions and labels, as the equation has them; mean over the batch. x (B, T, x_dim), y (B, M) classes."""
    mean, log_var = encoder(x, one_hot_labels(y, sizes))
    z, kl = sample(mean, log_var, len(decoder.circle) > 0)
    states = gaussian_log_prob(x, *decoder.unroll(z, x.shape[1])).sum((1, 2)).mean()
    labels = sum((-F.cross_entropy(head(z[:, parts[m]]), y[:, m]) for m, head in enumerate(classifiers)), torch.zeros(()))
    return states, labels, kl.sum(1).mean()


def train(encoder, decoder, x, y, sizes, variant, config):
    """Maximise Eq. 4. x (N, T, x_dim) displacements, y (N, M) classes, sizes: number of classes of each label (none: []).
    Trains encoder and decoder in place and returns the seconds it took."""
    z_dim = encoder.head[2].out_features // 2
    classifiers, parts = label_decoders(config["LABELS"].split(), z_dim, len(decoder.circle) > 0, config["OWN_AXIS"])
    model = nn.ModuleList([encoder, decoder, classifiers])
    epochs = config["EPOCHS"]
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, fused=True)
    epoch, seconds, last_save, per_epoch = 0, 0.0, time.time(), len(x) // BATCH
    if resumable(OUT, "wetvae-checkpoint", variant, SEED, RESUME):
        state = load(OUT, "wetvae-checkpoint", variant, SEED)
        check_same(state, config, set(config) - {"RESUME", "OUT", "THREADS", "CHECKPOINT", "BASELINE"})
        model.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])
        epoch, seconds = state["epoch"], state["seconds"]
        torch.set_rng_state(state["rng"])
    while epoch < epochs:
        clock = time.time()
        for i, rows in enumerate(torch.randperm(len(x))[:per_epoch * BATCH].view(per_epoch, BATCH)):
            progress = (epoch + i / per_epoch) / epochs
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * (1 - progress)
            states, labels, kl = objective(encoder, decoder, classifiers, parts, x[rows], y[rows], sizes)
            beta = config["BETA"] * (min(1, progress / config["BETA_WARM_UP"]) if config["BETA_WARM_UP"] else 1)
            loss = -(states + config["GAMMA"] * labels - beta * kl)  # Eq. 4
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        epoch += 1
        seconds += time.time() - clock
        if not math.isfinite(loss.item()):
            stop(f"the loss is {loss.item()} in epoch {epoch}; nothing was overwritten: go on from the last good "
                 f"{artifact_name('wetvae-checkpoint', variant, SEED)} with --resume true, or lower --learning_rate", code=1)
        if epoch % 4 == 0 or epoch == epochs:
            print(f"epoch {epoch:3d}/{epochs}  objective {-loss.item():8.3f}  log p(tau|z) {states.item():7.3f}  log p(y|z) "
                  f"{labels.item():7.3f}  KL {kl.item():6.3f}  {epoch * per_epoch / seconds:4.0f} updates/s  "
                  f"{seconds * (epochs / epoch - 1):4.0f} s left", flush=True)
        if time.time() - last_save >= 60 * CHECKPOINT or epoch == epochs:
            save(OUT, "wetvae-checkpoint", variant, SEED, config, model=model.state_dict(), optimizer=optimizer.state_dict(),
                 epoch=epoch, seconds=seconds, rng=torch.get_rng_state())
            last_save = time.time()
    return seconds


def one_hot_labels(y, sizes):
    return torch.cat([F.one_hot(y[:, m], k).float() for m, k in enumerate(sizes)] or [torch.zeros(len(y), 0)], 1)


def match_axes(z, factors, names):
    """Alg. 1, "Test: check factors in z": one latent per factor, best total |correlation|.

    z (N, M), factors (N, M). Returns the signed permutation (M, M) that turns canonical z, where axis m is factor m
    and + is more of it, into the latents of training, and the |correlations| (M,). A direction's circle may be cut open anywhere on
    an axis: its correlation is that with the best cut."""
    M, corr = z.shape[1], np.zeros((z.shape[1], len(names)))  # latents x factors
    for m, name in enumerate(names):
        cuts = np.linspace(-math.pi, math.pi, 361)[1:] if name == "direction" else [0.0]
        tries = np.array([np.corrcoef(z.T, (factors[:, m] - c + math.pi) % (2 * math.pi) if len(cuts) > 1 else factors[:, m])[:M, M]
                          for c in cuts])
        corr[:, m] = tries[abs(tries).argmax(0), np.arange(M)]
    best = max(itertools.permutations(range(M)), key=lambda p: sum(abs(corr[p[m], m]) for m in range(M)))
    axes = np.zeros((M, M), np.float32)
    for m, latent in enumerate(best):
        axes[m, latent] = np.sign(corr[latent, m]) or 1
    return torch.from_numpy(axes), np.array([abs(corr[best[m], m]) for m in range(M)])


def match_circle(pair, direction):
    """The same for a pair of latents on a circle (N, 2) and a direction (N,): sign and offset such that angle = sign direction +
    offset, and how closely (1: always, 0: not at all)."""
    angle = np.arctan2(pair[:, 1], pair[:, 0])
    mean = {sign: np.exp(1j * (angle - sign * direction)).mean() for sign in (1, -1)}
    sign = max(mean, key=lambda k: abs(mean[k]))
    return sign, np.angle(mean[sign]), abs(mean[sign])


def canonical_axes(decoder, z, factors, names):
    """Find which latent (N, L) is which factor (N, M) and tell the decoder; returns the latents as canonical z (N, M) and |corr| (M,)."""
    if not len(decoder.circle):
        decoder.axes, corr = match_axes(z, factors, names)
        return z @ decoder.axes.numpy().T, corr
    d, corr = names.index("direction"), np.zeros(len(names))
    rest = [m for m in range(len(names)) if m != d]
    axes, corr[rest] = match_axes(z[:, 2:], factors[:, rest], [names[m] for m in rest])
    sign, offset, corr[d] = match_circle(z[:, :2], factors[:, d])
    decoder.axes[:] = 0
    decoder.axes[rest, 2:], decoder.circle = axes, torch.tensor([d, sign, offset], dtype=torch.float32)
    canonical = z @ decoder.axes.numpy().T
    canonical[:, d] = ((np.arctan2(z[:, 1], z[:, 0]) - offset) * sign + math.pi) % (2 * math.pi) - math.pi
    canonical[:, d] *= 3 / (2 * math.pi)
    return canonical, corr


def mig_and_sap(z, factors, bins=20):
    """Per factor: Mutual Information Gap (bits of the best latent minus the second, over the factor's entropy) and
    Separated Attribute Predictability (R^2 of the best linear predictor minus the second). (N, M) each -> (M,), (M,)."""
    def codes(v):  # equal-count bins
        return np.searchsorted(np.quantile(v, np.arange(1, bins) / bins), v)
    mig, sap = [], []
    for f in factors.T:
        information = []
        for latent in z.T:
            joint = np.histogram2d(codes(latent), codes(f), bins=[np.arange(bins + 1) - 0.5] * 2)[0] / len(f)
            outer = joint.sum(1, keepdims=True) * joint.sum(0, keepdims=True)
            information.append((joint[joint > 0] * np.log(joint[joint > 0] / outer[joint > 0])).sum())
        p = np.bincount(codes(f)) / len(f)
        first, second = np.sort(information)[::-1][:2]
        mig.append((first - second) / -(p[p > 0] * np.log(p[p > 0])).sum())
        first, second = np.sort(np.corrcoef(z.T, f)[-1, :-1] ** 2)[::-1][:2]
        sap.append(first - second)
    return np.array(mig), np.array(sap)


def traverse(decoder, axis, values, steps):
    """Decoded displacements (len(values), steps, x_dim) while one axis runs over values and the others stay at BASE."""
    z = torch.tensor([float(v) for v in BASE.split()[:len(decoder.axes)]]).repeat(len(values), 1)
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    with torch.no_grad():
        return decoder(z, steps)[0].double().numpy()


def largest_gap(decoder, axis):
    """The largest empty angle in degrees: of the directions that a dense traversal of z_dir decodes to at a speed of at least 0.1."""
    reach = 1.5 if len(decoder.circle) else 3.0  # a circle is closed after 1.5
    first = traverse(decoder, axis, np.linspace(-reach, reach, 3001), 1)
    moving = first[np.linalg.norm(first[:, 0], axis=1) > 0.1]
    return 360 - math.degrees(spread(factors_of(moving)["direction"], "direction")) if len(moving) else 360.0


def measure(labels, settings, decoder, abs_corr, z, factors, names, ranges, seconds):
    """Print and save what the model learned: one row per factor in results/wetvae.csv, the matrix in results/crosstalk.csv."""
    curves = [factors_of(traverse(decoder, i, np.linspace(-1.5, 1.5, 61), LENGTH), "acceleration" in names) for i in range(len(names))]
    C, purity = cross_talk(curves, names, ranges)
    mig, sap = mig_and_sap(z, factors)
    print(f"\n{EXPERIMENT}, {labels}: cross-talk C[axis, factor], purity, |corr|, MIG, SAP; decoded factor over z in [-1.5, 1.5]")
    rows, cells = [], []
    for i, name in enumerate(names):
        curve = np.degrees(curves[i][name]) if name in ("direction", "curvature") else curves[i][name]
        low, high = curve.min(), curve.max()
        gap = largest_gap(decoder, i) if name == "direction" and ranges[i] > 4 else ""
        print(f"z_{name:12s} " + " ".join(f"{c:5.2f}" for c in C[i]) + f"   purity {purity[i]:.3f}  |corr| {abs_corr[i]:.3f}  "
              f"MIG {mig[i]:.3f}  SAP {sap[i]:.3f}  {low:7.2f} .. {high:.2f}" + (f"  largest empty angle {gap:.1f} deg" if gap != "" else ""))
        rows.append(dict(experiment=EXPERIMENT, seed=SEED, labels=labels, beta=settings["BETA"], gamma=settings["GAMMA"], factor=name,
                         abs_corr=abs_corr[i], purity=purity[i], range_low=low, range_high=high, mig=mig[i], sap=sap[i],
                         largest_gap_deg=gap, train_seconds=round(seconds)))
        cells += [dict(experiment=EXPERIMENT, seed=SEED, labels=labels, axis=name, factor=other, crosstalk=C[i, j])
                  for j, other in enumerate(names)]
    update_csv(Path(OUT) / "results" / "wetvae.csv", rows, ("experiment", "seed", "labels", "factor"))
    update_csv(Path(OUT) / "results" / "crosstalk.csv", cells, ("experiment", "seed", "labels", "axis", "factor"))


def draw_traversals(columns):
    """Fig 4, 10, 11, 12, 13: a row per axis, a column per (title, model, T). Lines are coloured by the value of the latent; where paths
    would hide one another (one dimension, acceleration), points are coloured by time and the latent is on the y axis."""
    models = [load(OUT, "wetvae", variant, SEED, quiet=True) for _, variant, _ in columns]
    rows = len(models[0]["names"])
    figure, axes = plt.subplots(rows, len(columns), figsize=(2.6 * len(columns) + 0.8, 2.4 * rows), squeeze=False)
    values, lined = np.linspace(-1.5, 1.5, 13), False
    colours = plt.get_cmap(common.TRAVERSAL_MAP)(np.linspace(0, 0.95, 13))
    for j, ((title, _, steps), model) in enumerate(zip(columns, models)):
        decoder, labelled = load_decoder(model), bool(model["config"]["LABELS"])
        for i, name in enumerate(model["names"]):
            ax, axis = axes[i, j], f"z_{name}" if labelled else f"latent nearest {name}"
            same = j and model["names"] == models[0]["names"] and labelled
            paths = np.pad(traverse(decoder, i, values, steps).cumsum(1), ((0, 0), (1, 0), (0, 0)))
            if paths.shape[2] == 1 or name == "acceleration":
                for t, colour in enumerate(plt.get_cmap("plasma")(np.linspace(0, 0.85, steps + 1))):
                    ax.plot(paths[:, t, 0], values, ".", color=colour, label=f"t = {t}")
                ax.set(ylabel="" if same else axis)
                if (i, j) == (rows - 1, len(columns) - 1):
                    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1))
            else:
                for path, colour in zip(paths, colours):
                    ax.plot(*path.T, ".-", ms=3, lw=1, color=colour)
                ax.set(ylabel="" if same else f"{axis}\ny")
                ax.set_aspect("equal", "datalim")
                lined = True
            ax.set(title=title if i == 0 else None, xlabel="x (trajectory units)" if i == rows - 1 else None)
    if lined:
        bar = figure.colorbar(plt.cm.ScalarMappable(plt.Normalize(-1.5, 1.5), common.TRAVERSAL_MAP), ax=axes, shrink=0.5)
        bar.set_label("value of the traversed latent, others " + BASE[:1 if len(set(BASE.split())) == 1 else None])
    save_figure(figure, OUT, FIGURE)


def draw_seeds(name):
    """Purity, |corr| and the largest empty angle of every seed trained so far: each seed a point, the mean with its 95 % interval."""
    rows = [row for row in read_csv(Path(OUT) / "results" / "wetvae.csv") if row["experiment"] == EXPERIMENT]
    factors, models = (list(dict.fromkeys(row[key] for row in rows)) for key in ("factor", "labels"))
    columns = {"purity": "purity of the axis", "abs_corr": "|corr| with its factor", "largest_gap_deg": "largest empty angle (degrees)"}
    columns = {key: text for key, text in columns.items() if any(row[key] for row in rows)}
    figure, axes = plt.subplots(1, len(columns), figsize=(4.2 * len(columns), 3.2))
    for ax, (column, text) in zip(axes, columns.items()):
        shown = [f for f in factors if any(row[column] for row in rows if row["factor"] == f)]
        for k, (labels, colour) in enumerate(zip(models, (common.BLUE, common.RED, common.GREY))):
            for i, factor in enumerate(shown):
                v = np.array([float(row[column]) for row in rows if (row["labels"], row["factor"]) == (labels, factor) and row[column]])
                low, high = bootstrap_interval(v)
                at = i + 0.25 * (k - (len(models) - 1) / 2)
                title = "Gaussian axis" if "circle" in models else "WET-VAE"
                title = {"none": "trajectory VAE", "circle": "circle", "plain": "as printed"}.get(labels, title)
                ax.plot(at + np.linspace(-0.08, 0.08, len(v)), v, ".", color=colour, alpha=0.6, label=f"{title}, {len(v)} seeds" if i == 0 else None)
                ax.errorbar(at, v.mean(), [[v.mean() - low], [high - v.mean()]], color="black", fmt="_", ms=14, capsize=3)
                worst = v.max() if column == "largest_gap_deg" else v.min()
                print(f"{title:15s} {column:15s} z_{factor:12s} mean {v.mean():7.3f} [{low:.3f}, {high:.3f}], worst {worst:.3f}, n = {len(v)}")
        ax.set(xticks=range(len(shown)), xticklabels=[f"z_{f}" for f in shown], ylabel=text, xlim=(-0.5, len(shown) - 0.5))
        ax.set_ylim(0, None if column == "largest_gap_deg" else 1.02)
    axes[0].legend(loc="lower left")
    save_figure(figure, OUT, name)


if __name__ == "__main__":
    config = parse_flags(globals())
    if unknown := set(LABELS.split()) - set(LABEL_RULES):
        stop(f"no weak label {sorted(unknown)[0]!r}; allowed: {' '.join(LABEL_RULES)}")
    torch.set_num_threads(THREADS)
    dataset = load(OUT, "dataset", DATA, DATA_SEED)
    truth = dict(zip(map(str, dataset["names"]), dataset["factors"].T.astype(np.float64)))
    ranges = dict(zip(truth, dataset["ranges"].tolist()))
    x = torch.from_numpy(np.diff(dataset["trajectories"], axis=1))  # displacements: the model is position-agnostic
    if x.shape[2] == 2:
        truth |= dict(x=truth["speed"] * np.cos(truth["direction"]), y=truth["speed"] * np.sin(truth["direction"]))
        ranges |= dict(x=2.0, y=2.0)
    LENGTH = x.shape[1]
    test = slice(len(x) - HELD_OUT, None)
    if not 2 * BATCH <= len(x) - HELD_OUT:
        stop(f"{len(x)} trajectories are too few for --batch {BATCH} and --held_out {HELD_OUT}; make more with 01_make_dataset.py")

    for key, changes in MODELS.items():
        if key == "none" and not BASELINE:
            continue
        variant, settings = f"{EXPERIMENT}_{key}".strip("_"), config | changes
        if key == "none":
            settings |= dict(BETA=BASELINE_BETA, EPOCHS=BASELINE_EPOCHS)
        labels = settings["LABELS"].split()
        sizes = [LABEL_RULES[name][0] for name in labels]
        y = torch.from_numpy(weak_labels(truth, labels)) if labels else torch.zeros(len(x), 0, dtype=torch.int64)
        sets = [part.split() for part in (settings["FACTORS"] or " ".join(map(str, dataset["names"]))).split(",")]
        circle = settings["CIRCLE"] and "direction" in sets[0]
        torch.manual_seed(SEED)
        encoder = Encoder(x.shape[2], sum(sizes), len(sets[0]) + circle)
        decoder = Decoder(len(sets[0]), x.shape[2], HIDDEN, circle)
        if TRAIN:
            print(f"\n{variant}: {'WET-VAE, labels ' + ' '.join(labels) if labels else 'trajectory VAE, no labels'}, beta {settings['BETA']:g}, "
                  f"gamma {settings['GAMMA']:g}, seed {SEED}")
            seconds = train(encoder, decoder, x[:-HELD_OUT], y[:-HELD_OUT], sizes, variant, settings)
        else:
            model = load(OUT, "wetvae", variant, SEED)
            check_same(model, settings, ("DATA", "LABELS", "HIDDEN", "CIRCLE"))
            encoder.load_state_dict(model["encoder"])
            decoder, seconds = load_decoder(model), model["seconds"]
        with torch.no_grad():
            latents = encoder(x[test], one_hot_labels(y[test], sizes))[0].double().numpy()
        for names in reversed(sets):  # the last of them, the first set, is the one that is kept
            factors = np.stack([truth[name][test] for name in names], 1)
            z, abs_corr = canonical_axes(decoder, latents, factors, names)
            measure(key or EXPERIMENT, settings, decoder, abs_corr, z, factors, names, [ranges[name] for name in names], seconds)
        if TRAIN:
            save(OUT, "wetvae", variant, SEED, settings, encoder=encoder.state_dict(), decoder=decoder.state_dict(), names=names,
                 ranges=[ranges[name] for name in names], abs_corr=abs_corr.tolist(), seconds=seconds)
    if EXPERIMENT == "seeds":
        draw_seeds(FIGURE)
    elif FIGURE:
        draw_traversals([column for column in COLUMNS if BASELINE or not column[1].endswith("none")])
        if EXPERIMENT == "full":
            draw_seeds("seeds_full_circle")
