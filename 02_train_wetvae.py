"""Stage 2: trajectories -> WET-VAE: disentangled skills and their decoder (Sec. 4.1, App. A.1.2).

In: runs/dataset_*.npz of 01. Trains the WET-VAE (Eq. 4) and, to compare, the trajectory VAE (NONE: no labels,
beta 1), finds which latent is which factor, and the relation functions. Out, below runs/:
wetvae_<model>_seed<n>.pt, a figure and results/wetvae.csv. Takes 1.2 to 2 minutes on one core, half of
that with --experiment main. Expect (speed, direction, curvature; mean of 10 seeds) purity 0.91, 0.91, 0.92;
the axes cover 67, 74, 55 % of the factors' ranges; relation weight 0.21 (the paper: -0.2; signs differ).
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
from common import (MULTI, Count, Decoder, Positive, Share, Threads, commands_of, factors_of, load, plt, stop,
                    weak_labels)

EXPERIMENT: str = "fig04_latent_traversals"  # a figure of FIGURES, with all its models, or a model of MODELS
SEED: int = 0                # random seed, of the data set too
OUT: str = "runs"            # folder of all that is written
TRAIN: bool = True           # false: only measure and draw what is trained already
THREADS: Threads = 1         # CPU threads: two are no faster, and three times slower on a busy machine

DATA: str = "main"           # experiment of 01 to train on
LABELS: str = "speed direction curvature"  # the M factors of interest: a latent and a weak label y^m for each
LABELLED: bool = True        # false: without the weak labels, the trajectory VAE (Co-Reyes et al. 2018)
OWN_AXIS: bool = True        # label m is read from latent m alone (the paper: from all of z; axes can mix)
GAMMA: float = 10.0          # weight of the label log-likelihoods, Eq. 4
BETA: float = 9.0            # weight of the KL divergence, Eq. 4
BETA_WARM_UP: Share = 0.5    # share of the updates in which beta grows (the paper: 0; then more robots fall)
HIDDEN: Count = 64           # width of every unit in Fig 1
BATCH: Count = 512           # trajectories per update (the paper: 2048)
EPOCHS: Count = 12           # passes over the data (the paper: 300)
LEARNING_RATE: Positive = 2e-3  # of Adam, falls linearly to 0 (the paper: 2e-4, fixed)
Z_RANGE: Positive = 1.5      # relation functions are found, and traversals drawn, from -Z_RANGE to Z_RANGE

NONE = dict(LABELLED=False, GAMMA=0, BETA=1, BETA_WARM_UP=0)  # with BETA 9 its latents collapse
PRINTED = dict(OWN_AXIS=False, BETA_WARM_UP=0)  # Eq. 4 as printed; mixes axes with some seeds
POLAR = dict(DATA="polar", LABELS="speed direction")  # Fig 11
LINE = dict(DATA="speed_acc", LABELS="speed acceleration", EPOCHS=24, BETA=4, Z_RANGE=1)  # Fig 12
FOUR = dict(DATA="four_factors", LABELS="speed direction curvature acceleration", EPOCHS=60, BETA=4)  # Fig 13
WEIGHTS = [(9, 0), (9, 1), (1, 10), (3, 10), (9, 10)]  # beta and gamma of our Fig 10
MODELS = {  # a row names the constants, from DATA to Z_RANGE, in which a model differs
    "main": {}, "main_none": NONE, "full": dict(DATA="full"), "four_factors": FOUR,
    "polar": POLAR, "polar_cartesian": POLAR | dict(LABELS="x y"),
    "polar_none": POLAR | NONE | dict(LABELS="x y"), "speed_acc": LINE, "speed_acc_none": LINE | NONE,
    # For ten seeds: main again; own axes alone; warm-up alone; neither (24 epochs); main_none again.
    "seeds": {}, "seeds_own_axis": dict(BETA_WARM_UP=0), "seeds_warm_up": dict(OWN_AXIS=False),
    "seeds_plain": PRINTED | dict(EPOCHS=24), "seeds_none": NONE, "beta_gamma": PRINTED,
} | {f"beta_gamma_b{beta}_g{gamma}": PRINTED | dict(BETA=beta, GAMMA=gamma) for beta, gamma in WEIGHTS}
FIGURES = {  # a column: title ("": model, beta and gamma), model, T of its traversals (0: T of the data)
    "fig04_latent_traversals": [
        ("(a) WET-VAE, T = 1", "main", 1), ("(b) WET-VAE, T = 5", "main", 5),
        ("(c) WET-VAE, T = 10", "main", 10), ("(d) trajectory VAE, T = 5", "main_none", 5)],
    "fig10_beta_gamma": [("", f"beta_gamma_b{beta}_g{gamma}", 0) for beta, gamma in WEIGHTS],
    "fig11_polar_cartesian": [("", "polar", 0), ("", "polar_cartesian", 0), ("", "polar_none", 0)],
    "fig12_speed_acceleration": [("", "speed_acc", 0), ("", "speed_acc_none", 0)],
    "fig13_four_factors": [("", "four_factors", 0)],
}


def supervision(dataset, hyper):
    """Displacements x (N, T, x_dim), the "distances" of App. A.1.2; the weak labels as one_hot (N, y_dim) for
    the encoder, and as classes y (N, M) for the cross-entropy; {factor: its range}, in the order of z."""
    x = np.diff(dataset["trajectories"], axis=1)
    factors = dict(zip(dataset["names"].tolist(), dataset["factors"].T.astype(np.float64)))
    ranges = dict(zip(factors, dataset["ranges"].tolist()))
    if x.shape[2] == 2:  # Cartesian factors, Fig 11
        factors |= factors_of(x.astype(np.float64), ["x", "y"])
        ranges |= dict.fromkeys(("x", "y"), [-ranges["speed"][1], ranges["speed"][1]])
    ranges = {name: ranges[name] for name in factors if name in hyper.LABELS.split()}
    y = torch.from_numpy(weak_labels(factors, list(ranges), ranges))  # Alg. 1, "Compute labels"
    one_hot = [F.one_hot(y[:, m], common.CLASSES[name]).float() for m, name in enumerate(ranges)]
    one_hot = torch.cat(one_hot, 1) if hyper.LABELLED else torch.zeros(len(y), 0)
    return torch.from_numpy(x), one_hot, y, ranges


class Encoder(nn.Module):
    """q_phi(z | tau, y), Fig 1: an LSTM reads displacements and labels; its last state gives a Gaussian."""
    def __init__(self, x_dim, y_dim, z_dim, hidden):
        super().__init__()
        self.cell = nn.LSTMCell(x_dim + y_dim, hidden)  # in short loops faster than nn.LSTM
        self.head = nn.Sequential(nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, 2 * z_dim))

    def forward(self, x, one_hot):
        """x (B, T, x_dim), labels one_hot (B, y_dim) -> mean, log-variance (B, z_dim) each."""
        state = None
        for displacement in x.unbind(1):
            state = self.cell(torch.cat([displacement, one_hot], 1), state)  # labels at each step, App. A.1.2
        return self.head(state[0]).chunk(2, 1)


class LabelDecoders(nn.Module):
    """p_theta(y^m | z), the M label decoders of Fig 1: MLPs over all of z (the paper) or, with own_axis, the
    logits scale * z^m * order_k + bias_k of classes k, which then lie in their order along latent m."""
    def __init__(self, labels, z_dim, hidden, own_axis):
        super().__init__()
        self.own_axis = own_axis
        sizes = [common.CLASSES[name] for name in labels]
        if own_axis:  # order_k: class 0 of curvature is zero, between class 1, positive, and 2, negative
            self.order = [torch.tensor([0.0, 1.0, -1.0]) if name in MULTI else torch.arange(float(size))
                          for name, size in zip(labels, sizes)]
            self.scale = nn.Parameter(torch.full((len(labels),), 3.0))
            self.bias = nn.ParameterList(torch.zeros(size) for size in sizes)
        else:
            self.heads = nn.ModuleList(
                nn.Sequential(nn.Linear(z_dim, hidden), nn.ReLU(), nn.Linear(hidden, size)) for size in sizes)

    def forward(self, z):
        """z (B, z_dim) -> the logits of each label's classes: M tensors (B, classes)."""
        if not self.own_axis:
            return [head(z) for head in self.heads]
        return [self.scale[m] * z[:, [m]] * order + self.bias[m] for m, order in enumerate(self.order)]


# -------- Eq. 3 and 4, and the first loop of Alg. 1 (the state decoder p_theta(tau | z) is common.Decoder)

def log_normal(x, mean, log_var):
    """log N(x; mean, exp(log_var)), elementwise; torch's gaussian_nll_loss would clamp small variances."""
    return -0.5 * ((x - mean) ** 2 * torch.exp(-log_var) + log_var + math.log(2 * math.pi))


def objective(encoder, decoder, label_decoders, x, one_hot, y):
    """The three terms of Eq. 3 and 4: sums over time, dimensions and labels, means over the batch.
    x (B, T, x_dim) displacements; the labels as one_hot (B, y_dim), side by side, and as classes y (B, M)."""
    mean, log_var = encoder(x, one_hot)
    z = mean + torch.randn_like(mean) * (0.5 * log_var).exp()  # z ~ q(z | tau, y); its axes are named later
    # sum_t log p(s_t | s_1:t-1, z); in place of s_1:t-1 the decoder reads its own means
    log_p_tau = log_normal(x, *decoder.decode_latents(z, x.shape[1])).sum((1, 2)).mean()
    logits = label_decoders(z)
    log_p_y = -sum(F.cross_entropy(logits[m], y[:, m]) for m in range(len(logits)))  # sum_m log p(y^m | z)
    kl = 0.5 * (mean ** 2 + log_var.exp() - 1 - log_var).sum(1).mean()  # D_KL(q(z | tau, y) || N(0, I))
    return log_p_tau, log_p_y, kl


def train(x, one_hot, y, names, hyper):
    """Alg. 1, "WET-VAE training". x, one_hot, y: see supervision. names of the M factors. hyper: the model's
    hyperparameters, one for each constant from DATA to Z_RANGE. Returns encoder and decoder."""
    encoder = Encoder(x.shape[2], one_hot.shape[1], len(names), hyper.HIDDEN)
    decoder = Decoder(len(names), x.shape[2], hyper.HIDDEN)
    label_decoders = LabelDecoders(names if hyper.LABELLED else [], len(names), hyper.HIDDEN, hyper.OWN_AXIS)
    networks = nn.ModuleList([encoder, decoder, label_decoders])  # Alg. 1: initialize phi, theta
    optimizer = torch.optim.Adam(networks.parameters(), fused=True)
    updates = len(x) // hyper.BATCH  # of an epoch; the few trajectories left are skipped
    for epoch in range(hyper.EPOCHS):
        for i, rows in enumerate(torch.randperm(len(x)).split(hyper.BATCH)[:updates]):  # Alg. 1: B ~ D
            log_p_tau, log_p_y, kl = objective(*networks, x[rows], one_hot[rows], y[rows])  # y: computed once
            progress = (epoch + i / updates) / hyper.EPOCHS
            grown = progress / hyper.BETA_WARM_UP if progress < hyper.BETA_WARM_UP else 1
            loss = -(log_p_tau + hyper.GAMMA * log_p_y - hyper.BETA * grown * kl)  # Eq. 4
            optimizer.param_groups[0]["lr"] = hyper.LEARNING_RATE * (1 - progress)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()  # Alg. 1: optimize phi, theta
        if epoch % 4 == 3 or epoch + 1 == hyper.EPOCHS:
            print(f"{epoch + 1:3d}/{hyper.EPOCHS}  log p(tau|z) {log_p_tau:7.3f}  log p(y|z) {log_p_y:7.3f}  "
                  f"KL {kl:6.3f}", flush=True)
    return encoder, decoder


# -------- the two lines "Test" of Alg. 1

@torch.no_grad()
def check_factors(decoder, names, steps):
    """Alg. 1, "Test: check factors in z" (the paper: by eye, from traversals). Decodes samples of the prior,
    and matches latents with factors by the largest total |correlation|. Sets decoder.axes, the signed
    permutation after which axis m of z is factor m and + is more of it. Returns the |correlations| (M,)."""
    n = len(names)
    latents = torch.randn(5000, n, generator=torch.Generator().manual_seed(0))  # z ~ p(z)
    found = list(factors_of(decoder.decode_latents(latents, steps)[0].double().numpy(), names).values())
    with np.errstate(invalid="ignore", divide="ignore"):  # a factor that never changes has no correlation
        corr = np.nan_to_num(np.corrcoef(latents.double().numpy().T, found)[:n, n:])  # latents x factors
    orders = itertools.permutations(range(n))
    best = list(max(orders, key=lambda order: abs(corr[order, range(n)]).sum()))  # best[m]: factor m's latent
    decoder.axes.zero_()
    decoder.axes[range(n), best] = torch.from_numpy(np.where(corr[best, range(n)] < 0, -1, 1)).float()
    return abs(corr[best, range(n)])


@torch.no_grad()
def find_relation(decoder, names, steps, z_range):
    """Alg. 1, "Test: find relation functions", from the decoder alone (the paper: by hand, after the policy).
    For each factor of z_multi: the weight in [-1, 1] with which single steps, chained by common.next_skill,
    come nearest to the free run, one decoder run of `steps` transitions with all of z, over a 13 x 13 grid
    of speed and factor. The error: RMS difference / RMS displacement. Returns {factor: weight}."""
    grid = torch.linspace(-z_range, z_range, 13)
    relation = {}
    for factor in [name for name in names if MULTI.get(name) in names]:
        z = torch.zeros(len(grid) ** 2, len(names))  # direction 0: a turn stays within the data's directions
        z[:, [0, names.index(factor)]] = torch.cartesian_prod(grid, grid)  # the first axis is the speed
        free_run = decoder(z, steps)[0]
        errors = {}  # of each weight
        for weight in sorted(np.linspace(-1, 1, 401).round(4).tolist(), key=abs):  # small ones win ties
            skills = SimpleNamespace(method="wedis", decoder=decoder, names=names, relation={factor: weight})
            chain = commands_of(skills, z, steps)
            errors[weight] = ((chain - free_run).square().mean() / free_run.square().mean()).sqrt().item()
        best = relation[factor] = min(errors, key=errors.get)
        print(f"relation function of {factor}: weight {best:+.3f}, {errors[best]:.1%} from the decoder's "
              f"free run ({errors[0.0]:.1%} without it)")
    return relation


def main():
    config, given = common.parse_flags(globals())
    torch.set_num_threads(THREADS)
    columns = FIGURES.get(EXPERIMENT) or [("", EXPERIMENT, 0)]
    models, datasets = check(columns, config, given)
    trained = {}
    for name, hyper in models.items():
        if TRAIN:
            print(f"\n{name}, seed {SEED}, beta {hyper.BETA:g}, gamma {hyper.GAMMA:g}")
            clock = time.time()
            x, one_hot, y, ranges = supervision(datasets[hyper.DATA], hyper)
            names, steps = list(ranges), x.shape[1]
            torch.manual_seed(SEED)
            encoder, decoder = train(x, one_hot, y, names, hyper)
            seconds = time.time() - clock
            if not all(part.isfinite().all() for part in decoder.parameters()):
                stop("the loss is not finite, and nothing was overwritten; lower --learning_rate", code=1)
            abs_corr = check_factors(decoder, names, steps).tolist()
            relation = find_relation(decoder, names, steps, hyper.Z_RANGE) if hyper.LABELLED else {}
            made = common.digest(datasets[hyper.DATA]["config"] | dict(SEED=0, OUT="", FIGURE=""))
            settings = vars(hyper) | dict(DATASET=made)  # the same for all seeds
            example = []
            if hyper.LABELLED and "example" in datasets[hyper.DATA]:
                example = follow_one_skill(encoder, decoder, datasets[hyper.DATA], hyper)
            common.save(OUT, "wetvae", name, SEED, settings, decoder=decoder, encoder=encoder.state_dict(),
                        names=names, ranges=ranges, relation=relation, length=steps, seconds=seconds,
                        abs_corr=abs_corr, example=example)
        trained[name] = load(OUT, "wetvae", name, SEED, **vars(hyper), CLASSES=common.CLASSES)
        measure(name, trained[name])
    draw_traversals(trained, columns)


# ======== not needed to understand the method

def hyperparameters(name, config, given):
    """The constants from DATA to Z_RANGE: a model's row overrides the file, a flag that was given both."""
    values, kinds = config | MODELS.get(name, {}) | given, common.types_of(globals())
    return SimpleNamespace(**{key: common.convert(values[key], kinds[key], f"{key} of model {name}")
                              for key in list(kinds)[list(kinds).index("DATA"):]})


def check(columns, config, given):
    """The hyperparameters of the models, and their data sets. Ends with one line if any makes no sense."""
    if EXPERIMENT not in (*FIGURES, *MODELS):
        stop(f"unknown experiment {EXPERIMENT!r}; allowed: {' '.join([*FIGURES, *MODELS])}")
    for column in columns:
        if [*map(type, column)] != [str, str, int] or column[1] not in MODELS or column[2] < 0:
            stop(f"{column!r} in FIGURES must be (title, model, T), the model one of: {' '.join(MODELS)}")
    models = {name: hyperparameters(name, config, given) for _, name, _ in columns}
    for name, hyper in models.items():
        if unknown := [key for key in MODELS[name] if key not in vars(hyper)]:
            stop(f"{unknown[0]} of model {name} is no constant in which models can differ")
    datasets = {data: load(OUT, "dataset", data, SEED) for data in {m.DATA for m in models.values()} if TRAIN}
    for name, hyper in (models.items() if TRAIN else ()):
        data, at = datasets[hyper.DATA], f"model {name}, data set {hyper.DATA}: "
        make = f"python 01_make_dataset.py --seed {SEED} --experiment {hyper.DATA} --out {OUT}"
        known = data["names"].tolist() + ["x", "y"] * (data["trajectories"].shape[2] == 2)
        if not hyper.LABELS or set(hyper.LABELS.split()) - set(known):
            stop(f"{at}--labels {hyper.LABELS!r} must be factors of these data, which are: {' '.join(known)}")
        x, _, y, ranges = supervision(data, hyper)
        if len(x) < hyper.BATCH:
            stop(f"{at}{len(x)} trajectories are fewer than --batch {hyper.BATCH}: lower it, or {make}")
        common.need_memory(160 * hyper.HIDDEN ** 2, "--hidden")
        for m, factor in enumerate(ranges if hyper.LABELLED else ()):
            counts = np.bincount(y[:, m], minlength=common.CLASSES[factor])
            mend = "take --data polar" if factor in ("x", "y") else f"make other data: {make}"
            if len(counts) > common.CLASSES[factor] or counts.min() < 0.005 * len(y):
                stop(f"{at}{counts.min()} of {len(y)} trajectories are of class {counts.argmin() + 1} of "
                     f"{factor}: leave it out of --labels, or {mend}")
    return models, datasets


@torch.no_grad()
def follow_one_skill(encoder, decoder, dataset, hyper):
    """Print what the model makes of the example that 01, 02 and 03 follow. Returns its z."""
    example = dataset | dict(trajectories=dataset["example"], factors=dataset["example_factors"])
    x, one_hot, _, ranges = supervision(example, hyper)
    z = encoder(x, one_hot)[0] @ decoder.axes.T  # latents -> axes of z: the inverse of Decoder.forward
    print("one skill, followed: the example of 01")
    print("  encoded: z =", ", ".join(f"{name} {value:+.2f}" for name, value in zip(ranges, z[0])))
    for text, rows in (("  its displacements:", x[0]), ("  decoded from z:   ", decoder(z, len(x[0]))[0][0])):
        print(text, *(f"({dx:.2f}, {dy:.2f})" for dx, dy in rows[:10]), " end:", rows.sum(0).numpy().round(2))
    return z[0].tolist()


@torch.no_grad()
def traverse(decoder, axis, values, steps):
    """Displacements (len(values), steps, x_dim) decoded while one axis runs over values, the others at 0."""
    z = torch.zeros(len(values), len(decoder.axes))
    z[:, 0] = -1.0 if decoder.x_dim == 1 else 0.0  # in 1D the speed: at 0 nothing can accelerate (Fig 12)
    z[:, axis] = torch.as_tensor(values, dtype=torch.float32)
    return decoder(z, steps)[0].double().numpy()


def measure(name, model):
    """Print what a model has learnt, z from -1.5 to 1.5, and write a row per factor to results/wetvae.csv."""
    decoder, names, values = model["decoder"], model["names"], np.linspace(-1.5, 1.5, 61)
    curves = [factors_of(traverse(decoder, i, values, model["length"]), names) for i in range(len(names))]
    (C, purity), rows = common.cross_talk(curves, model["ranges"]), []
    group = max((group for group in MODELS if name.startswith(group + "_")), key=len, default=name)
    same = dict(experiment=group, seed=SEED, labels=name.removeprefix(group + "_"))  # labels: the variant
    for i, factor in enumerate(names):
        curve = np.degrees(curves[i][factor]) if factor in ("direction", "curvature") else curves[i][factor]
        row = dict(factor=factor, abs_corr=model["abs_corr"][i], purity=purity[i],
                   crosstalk=", ".join(f"{other} {c:.2f}" for other, c in zip(names, C[i])),
                   range_low=curve.min(), range_high=curve.max(), largest_gap_deg="")
        if factor == "direction" and np.ptp(model["ranges"][factor]) > 6.28:  # empty angles, App. A.3.1
            first = traverse(decoder, i, np.linspace(-3, 3, 3001), 1)
            first = first[np.linalg.norm(first[:, 0], axis=1) > 0.1]
            if len(first):
                covered = common.spread(factors_of(first, [factor])[factor], factor)
                row["largest_gap_deg"] = 360 - math.degrees(covered)
        print(*(f"{k} {v:.2f}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items()), sep="  ")
        if row["abs_corr"] < 0.5 or math.isnan(purity[i]):
            print(f"no latent means {factor}: do not use z_{factor}")
        rows.append(same | dict(beta=model["config"]["BETA"], gamma=model["config"]["GAMMA"]) | row | dict(
            train_seconds=round(model["seconds"]), settings=common.digest(model["config"])))
    common.update_csv(Path(OUT) / "results" / "wetvae.csv", rows, (*same, "factor", "settings"))


def draw_traversals(trained, columns):
    """Fig 4, 10 to 13: a row per axis, a column per (title, model, T). Lines have the colour of the latent;
    where they would hide one another, points have that of time, and the latent is on y."""
    names = max((model["names"] for model in trained.values()), key=len)
    heights = [0.5 if name in ("speed", "acceleration") else 1.0 for name in names]
    figure, axes = plt.subplots(len(names), len(columns), squeeze=False, height_ratios=heights,
                                figsize=(2.8 * len(columns) + 0.9, 2.7 * sum(heights) + 0.8))
    reach, dots = max(model["config"]["Z_RANGE"] for model in trained.values()), None
    values = np.linspace(-reach, reach, 13)
    for j, (title, key, steps) in enumerate(columns):
        model, steps = trained[key], steps or trained[key]["length"]
        axes[0, j].set_title(title or "{}\nbeta {BETA:g}, gamma {GAMMA:g}".format(key, **model["config"]))
        axes[-1, j].set_xlabel("x (trajectory units)")
        for i, (ax, name) in enumerate(zip(axes[:, j], model["names"])):
            paths = np.pad(traverse(model["decoder"], i, values, steps).cumsum(1), ((0, 0), (1, 0), (0, 0)))
            ax.set_ylabel(f"z_{name}" if model["config"]["LABELLED"] else f"latent nearest {name}")
            if paths.shape[2] == 1 or name == "acceleration":
                value, t = np.meshgrid(values, range(steps + 1), indexing="ij")
                dots = ax.scatter(paths[..., 0], value, s=8, c=t, cmap="plasma")
            else:
                for path, colour in zip(paths, plt.get_cmap("viridis")(np.linspace(0, 0.95, 13))):
                    ax.plot(*path.T, ".-", ms=3, lw=1, color=colour)
                ax.set_aspect("equal", "datalim")
    if dots:
        figure.legend(*dots.legend_elements(fmt="t = {x:g}"), loc="outside lower center", ncols=9)
    bar = plt.cm.ScalarMappable(plt.Normalize(-reach, reach), "viridis")
    figure.colorbar(bar, ax=axes, label="value of the traversed latent (lines)", aspect=40)
    common.save_figure(figure, OUT, EXPERIMENT if EXPERIMENT in FIGURES else f"traversals_{EXPERIMENT}")


if __name__ == "__main__":
    main()
