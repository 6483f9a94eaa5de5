"""Stage 2: trajectories -> WET-VAE: disentangled skills and the decoder that predicts them (Sec. 4.1, App. A.1.2).

Reads runs/dataset_*.npz. Trains the WET-VAE (Eq. 4) and, for comparison, the same model without labels (the trajectory
VAE), finds which latent is which factor, and writes runs/wetvae_<experiment>_seed<seed>.pt (and <experiment>_none),
Fig 4, results/wetvae.csv and results/crosstalk.csv. Takes 4.3 minutes on two cores (AMD EPYC 7003, no AVX-512).
Expect: |corr| 0.98, 0.98, 0.91; purity 0.95, 0.93, 0.86; without labels the axes are entangled (seed 0).
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
from common import (LABEL_RULES, Decoder, artifact_name, bootstrap_interval, check_same, cross_talk, factors_of, gaussian_log_prob,
                    load, load_decoder, parse_flags, plt, read_csv, resumable, save, save_figure, stop, update_csv, weak_labels)

EXPERIMENT = "main"    # row of EXPERIMENTS below
SEED = 0               # random seed
OUT = "."              # folder for runs/, figures/ and results/
TRAIN = True           # false: only draw and measure what is already trained
RESUME = False         # true: continue from the last checkpoint
CHECKPOINT = 1.0       # minutes between checkpoints

DATA = "main"          # experiment of 01 to train on
DATA_SEED = 0          # and its seed
LABELS = "speed direction curvature"  # factors with a weak label y^m
BASELINE = True        # also train the trajectory VAE, the same model without labels

BETA = 9.0             # weight of the KL divergence, Eq. 4
BASELINE_BETA = 1.0    # of the trajectory VAE: at 9 its latent collapses (KL 0.000), which would make a straw man of it
GAMMA = 10.0           # weight of the label cross-entropies, Eq. 4
HIDDEN = 64            # width of every unit in Fig 1
BATCH = 1024           # trajectories per update (the paper: 2048)
EPOCHS = 36            # the paper: 300
LEARNING_RATE = 2e-3   # Adam, decays linearly to 0 (the paper: 2e-4, fixed)
HELD_OUT = 5000        # trajectories kept for |corr|, MIG and SAP
THREADS = 2            # CPU threads

EXPERIMENTS = {  # a row names the constants in which an experiment differs from the ones above
    "main": {},
    "seeds": {},  # the same; each --seed adds its rows to results/wetvae.csv and its points to the figure of all seeds
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


def objective(encoder, decoder, classifiers, x, y, sizes):
    """The three terms of Eq. 4: sum_t log p(s_t | s_<t, z), sum_m log p(y^m | z), D_KL(q(z | tau, y) || N(0, 1)). Sums over
    time, dimensions and labels, as the equation has them; mean over the batch. x (B, T, x_dim), y (B, M) classes."""
    mean, log_var = encoder(x, one_hot_labels(y, sizes))
    z = mean + torch.randn_like(mean) * (0.5 * log_var).exp()
    states = gaussian_log_prob(x, *decoder(z, x.shape[1])).sum((1, 2)).mean()
    labels = sum((-F.cross_entropy(head(z), y[:, m]) for m, head in enumerate(classifiers)), torch.zeros(()))
    kl = 0.5 * (mean ** 2 + log_var.exp() - 1 - log_var).sum(1).mean()
    return states, labels, kl


def train(x, y, sizes, z_dim, variant, config):
    """Maximise Eq. 4. x (N, T, x_dim) displacements, y (N, M) classes, sizes: number of classes of each label (none: [])."""
    torch.manual_seed(SEED)
    encoder, decoder = Encoder(x.shape[2], sum(sizes), z_dim), Decoder(z_dim, x.shape[2], HIDDEN)
    classifiers = nn.ModuleList(nn.Sequential(nn.Linear(z_dim, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, k)) for k in sizes)
    model = nn.ModuleList([encoder, decoder, classifiers])
    optimizer = torch.optim.Adam(model.parameters(), lr=LEARNING_RATE, fused=True)
    epoch, seconds, last_save, per_epoch = 0, 0.0, time.time(), len(x) // BATCH
    if resumable(OUT, "wetvae-checkpoint", variant, SEED, RESUME):
        state = load(OUT, "wetvae-checkpoint", variant, SEED)
        check_same(state, config, set(config) - {"RESUME", "OUT", "THREADS", "CHECKPOINT", "BASELINE"})
        model.load_state_dict(state["model"])
        optimizer.load_state_dict(state["optimizer"])
        epoch, seconds = state["epoch"], state["seconds"]
        torch.set_rng_state(state["rng"])
    while epoch < EPOCHS:
        clock = time.time()
        for i, rows in enumerate(torch.randperm(len(x))[:per_epoch * BATCH].view(per_epoch, BATCH)):
            for group in optimizer.param_groups:
                group["lr"] = LEARNING_RATE * (1 - (epoch + i / per_epoch) / EPOCHS)
            states, labels, kl = objective(encoder, decoder, classifiers, x[rows], y[rows], sizes)
            loss = -(states + GAMMA * labels - (BETA if sizes else BASELINE_BETA) * kl)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        epoch += 1
        seconds += time.time() - clock
        if not math.isfinite(loss.item()):
            stop(f"the loss is {loss.item()} in epoch {epoch}; nothing was overwritten: go on from the last good "
                 f"{artifact_name('wetvae-checkpoint', variant, SEED)} with --resume true, or lower --learning_rate", code=1)
        if epoch % 4 == 0 or epoch == EPOCHS:
            print(f"epoch {epoch:3d}/{EPOCHS}  objective {-loss.item():8.3f}  log p(tau|z) {states.item():7.3f}  log p(y|z) "
                  f"{labels.item():7.3f}  KL {kl.item():6.3f}  {epoch * per_epoch / seconds:4.0f} updates/s  "
                  f"{seconds * (EPOCHS / epoch - 1):4.0f} s left", flush=True)
        if time.time() - last_save >= 60 * CHECKPOINT or epoch == EPOCHS:
            save(OUT, "wetvae-checkpoint", variant, SEED, config, model=model.state_dict(), optimizer=optimizer.state_dict(),
                 epoch=epoch, seconds=seconds, rng=torch.get_rng_state())
            last_save = time.time()
    return encoder, decoder, seconds


def one_hot_labels(y, sizes):
    return torch.cat([F.one_hot(y[:, m], k).float() for m, k in enumerate(sizes)] or [torch.zeros(len(y), 0)], 1)


def match_axes(z, factors):
    """Alg. 1, "Test: check factors in z": one latent per factor, best total |correlation|.

    z (N, M), factors (N, M). Returns the signed permutation (M, M) that turns canonical z, where axis m is factor m
    and + is more of it, into the latents of training, and the |correlations| (M,)."""
    M = z.shape[1]
    corr = np.corrcoef(z.T, factors.T)[:M, M:]  # latents x factors
    best = max(itertools.permutations(range(M)), key=lambda p: sum(abs(corr[p[m], m]) for m in range(M)))
    axes = np.zeros((M, M), np.float32)
    for m, latent in enumerate(best):
        axes[m, latent] = np.sign(corr[latent, m]) or 1
    return torch.from_numpy(axes), np.array([abs(corr[best[m], m]) for m in range(M)])


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
    """Decoded displacements (len(values), steps, 2) while one axis runs over values and the others are 0."""
    z = torch.zeros(len(values), len(decoder.axes))
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    with torch.no_grad():
        return decoder(z, steps)[0].double().numpy()


def measure(variant, decoder, abs_corr, z, factors, names, seconds):
    """Print and save what the model learned: one row per factor in results/wetvae.csv, the matrix in results/crosstalk.csv."""
    curves = [factors_of(traverse(decoder, i, np.linspace(-1.5, 1.5, 61), LENGTH)) for i in range(len(names))]
    C, purity = cross_talk(curves, names)
    mig, sap = mig_and_sap(z, factors)
    labels = "none" if variant.endswith("none") else EXPERIMENT
    print(f"\n{variant}: cross-talk C[axis, factor], purity, |corr|, MIG, SAP; decoded factor over z in [-1.5, 1.5]")
    rows, cells = [], []
    for i, name in enumerate(names):
        curve = curves[i][name] if name == "speed" else np.degrees(curves[i][name])
        low, high = curve.min(), curve.max()
        print(f"z_{name:10s} " + " ".join(f"{c:5.2f}" for c in C[i]) + f"   purity {purity[i]:.3f}  |corr| {abs_corr[i]:.3f}  "
              f"MIG {mig[i]:.3f}  SAP {sap[i]:.3f}  {low:7.2f} .. {high:.2f}" + ("" if name == "speed" else " deg"))
        rows.append(dict(experiment=EXPERIMENT, seed=SEED, labels=labels,
                         beta=BASELINE_BETA if labels == "none" else BETA, gamma=GAMMA, factor=name,
                         abs_corr=abs_corr[i], purity=purity[i], range_low=low, range_high=high, mig=mig[i], sap=sap[i],
                         largest_gap_deg="", train_seconds=round(seconds)))
        cells += [dict(experiment=EXPERIMENT, seed=SEED, labels=labels, axis=name, factor=other, crosstalk=C[i, j])
                  for j, other in enumerate(names)]
    update_csv(Path(OUT) / "results" / "wetvae.csv", rows, ("experiment", "seed", "labels", "factor"))
    update_csv(Path(OUT) / "results" / "crosstalk.csv", cells, ("experiment", "seed", "labels", "axis", "factor"))


def draw_fig04(decoders, names):
    """Fig 4: a row per latent, a column per (model, T). Line colour: value of the latent, -1.5 to 1.5."""
    columns = [("(a) WET-VAE, T = 1", 0, 1), ("(b) WET-VAE, T = 5", 0, 5), ("(c) WET-VAE, T = 10", 0, 10),
               ("(d) trajectory VAE, T = 5", 1, 5)][:4 if len(decoders) > 1 else 3]
    figure, axes = plt.subplots(len(names), len(columns), figsize=(2.6 * len(columns) + 0.8, 2.5 * len(names)), squeeze=False)
    values, colours = np.linspace(-1.5, 1.5, 13), plt.get_cmap(common.TRAVERSAL_MAP)(np.linspace(0, 0.95, 13))
    for j, (title, model, steps) in enumerate(columns):
        for i in range(len(names)):
            paths = np.pad(traverse(decoders[model], i, values, steps).cumsum(1), ((0, 0), (1, 0), (0, 0)))
            for path, colour in zip(paths, colours):
                axes[i, j].plot(*path.T, ".-", ms=3, lw=1, color=colour)
            label = f"z_{names[i]}" if model == 0 else f"latent nearest {names[i]}"
            axes[i, j].set(title=title if i == 0 else None, xlabel="x (trajectory units)" if i == len(names) - 1 else None,
                           ylabel=f"{label}\ny" if j == 0 or model else "")
            axes[i, j].set_aspect("equal", "datalim")
    bar = figure.colorbar(plt.cm.ScalarMappable(plt.Normalize(-1.5, 1.5), common.TRAVERSAL_MAP), ax=axes, shrink=0.5)
    bar.set_label("value of the traversed latent, others 0")
    save_figure(figure, OUT, "fig04_latent_traversals" + ("" if EXPERIMENT == "main" else f"_{EXPERIMENT}"))


def draw_seeds():
    """Purity and |corr| of every seed trained so far, of both models: each seed a point, the mean with its 95 % bootstrap interval."""
    rows = [row for row in read_csv(Path(OUT) / "results" / "wetvae.csv") if row["experiment"] == EXPERIMENT]
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), sharey=True)
    for ax, measure in zip(axes, ("purity", "abs_corr")):
        for labels, name, colour, shift in ((EXPERIMENT, "WET-VAE", common.BLUE, -0.15), ("none", "trajectory VAE", common.RED, 0.15)):
            for i, factor in enumerate(LABELS.split()):
                v = np.array([float(row[measure]) for row in rows if row["labels"] == labels and row["factor"] == factor])
                if len(v):
                    low, high = bootstrap_interval(v)
                    spread = np.linspace(-0.08, 0.08, len(v))
                    ax.plot(i + shift + spread, v, ".", color=colour, alpha=0.6, label=f"{name}, {len(v)} seeds" if i == 0 else None)
                    ax.errorbar(i + shift, v.mean(), [[v.mean() - low], [high - v.mean()]], color="black", fmt="_", ms=14, capsize=3)
                    print(f"{name:15s} {measure:9s} z_{factor:10s} mean {v.mean():.3f} [{low:.3f}, {high:.3f}], worst {v.min():.3f}, n = {len(v)}")
        ax.set(xticks=range(len(LABELS.split())), xticklabels=[f"z_{f}" for f in LABELS.split()], ylim=(0, 1.02),
               ylabel={"purity": "purity of the axis", "abs_corr": "|corr| with its factor"}[measure])
    axes[0].legend(loc="lower left")
    save_figure(figure, OUT, "seeds_wetvae")


if __name__ == "__main__":
    config = parse_flags(globals())
    if unknown := set(LABELS.split()) - set(LABEL_RULES):
        stop(f"no weak label {sorted(unknown)[0]!r}; allowed: {' '.join(LABEL_RULES)}")
    torch.set_num_threads(THREADS)
    dataset = load(OUT, "dataset", DATA, DATA_SEED)
    names = [str(name) for name in dataset["names"]]
    factors = dataset["factors"]
    x = torch.from_numpy(np.diff(dataset["trajectories"], axis=1))  # displacements: the model is position-agnostic
    LENGTH = x.shape[1]
    test = slice(len(x) - HELD_OUT, None)
    if not 2 * BATCH <= len(x) - HELD_OUT:
        stop(f"{len(x)} trajectories are too few for --batch {BATCH} and --held_out {HELD_OUT}; make more with 01_make_dataset.py")

    decoders = []
    for variant, label_names in [(EXPERIMENT, LABELS.split())] + [(EXPERIMENT + "_none", [])] * BASELINE:
        sizes = [LABEL_RULES[name][0] for name in label_names]
        y = torch.zeros(len(x), 0, dtype=torch.int64)
        if label_names:
            y = torch.from_numpy(weak_labels(dict(zip(names, factors.T.astype(np.float64))), label_names))
        if TRAIN:
            print(f"\n{variant}: {'WET-VAE' if label_names else 'trajectory VAE, no labels'}, seed {SEED}")
            train_set = slice(len(x) - HELD_OUT)
            encoder, decoder, seconds = train(x[train_set], y[train_set], sizes, len(names), variant, config)
            with torch.no_grad():
                mean, _ = encoder(x[test], one_hot_labels(y[test], sizes))
            decoder.axes, abs_corr = match_axes(mean.numpy(), factors[test])
            save(OUT, "wetvae", variant, SEED, config, encoder=encoder.state_dict(), decoder=decoder.state_dict(), names=names,
                 abs_corr=abs_corr.tolist(), seconds=seconds)
        model = load(OUT, "wetvae", variant, SEED)
        check_same(model, config, ("DATA", "LABELS", "HIDDEN"))
        encoder, decoder = Encoder(x.shape[2], sum(sizes), len(names)), load_decoder(model)
        encoder.load_state_dict(model["encoder"])
        with torch.no_grad():
            mean, _ = encoder(x[test], one_hot_labels(y[test], sizes))
        measure(variant, decoder, model["abs_corr"], (mean @ decoder.axes.T).numpy(), factors[test], names, model["seconds"])
        decoders.append(decoder)
    if EXPERIMENT == "seeds":
        draw_seeds()
    else:
        draw_fig04(decoders, names)
