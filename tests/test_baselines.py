"""Stage 3, the baselines: one pass of each training loop over a replay buffer made by hand, against
torch.distributions and plain loops.
Their trainings from the command line, and that these resume with the same bits: test_policy.py."""
import math

import common
import pytest
import torch
from conftest import one_pass
from torch import distributions as D


# ---------------------------------------------------------------- DADS

@pytest.fixture
def dads(s3, monkeypatch):
    """dads(passes) -> passes of train_dads that draw from 300 stored steps: skills drive, and noise."""
    torch.manual_seed(0)
    vars(s3).update(METHOD="dads", ROBOTS=3, SKILL_STEPS=5, EPISODE=10, REPLAY=300, WARM_UP=10, HIDDEN=8, THREADS=1,
                    UPDATES=10 ** 9, UPDATES_PER_STEP=1, BATCH=64, MODEL_BATCH=50, MODEL_UPDATES=2, PRIOR_SAMPLES=30,
                    RELABELLED=0.0, RECENT=120, LEARNING_RATE=0.0)

    def fill(replay):
        replay.added = 300
        stored = replay.read(slice(0, 300))
        stored.s.copy_(torch.randn(300, 27))
        stored.s2.copy_(torch.randn(300, 27))
        stored.z.copy_(torch.rand(300, 2) * 2 - 1)
        stored.displacement.copy_(stored.z @ torch.tensor([[0.0, 0.04], [-0.04, 0.0]]) + 0.01 * torch.randn(300, 2))
        stored.displacement[180:] *= 2  # the latest 120

    def run(passes=1, prepare=lambda log: None):
        done = one_pass(s3, monkeypatch, lambda: s3.train_dads(None, []), fill, prepare, passes)
        done.q = done.log.policy.decoder
        return done
    return run


def information(q, d, z, others):
    """log(L + 1) - log(1 + sum_i exp(log q(d | z_i) - log q(d | z))), one displacement (in units) at a time. q(. | z):
    a Gaussian of deviation 1."""
    def log_q(d, z):
        return D.Independent(D.Normal(q(z, 1)[0][:, 0].detach(), 1.0), 1).log_prob(d)
    found = []
    for i in range(len(d)):
        away = log_q(d[i].expand(len(others), 2), others) - log_q(d[i:i + 1], z[i:i + 1])
        found.append(math.log(len(others) + 1) - math.log1p(away.clamp(-50, 50).double().exp().sum().item()))
    return torch.tensor(found)


def test_one_pass_of_dads_learns_q_and_pays_the_information(s3, dads):
    done = dads(prepare=lambda log: log.policy.decoder.head[2].weight.data.mul_(30))
    rows = (done.batch.s[:, None, 0] == done.stored.s[:, 0]).int().argmax(1)  # which of the stored steps these are
    for name in ("s", "a", "s2", "displacement", "z"):
        assert torch.equal(vars(done.batch)[name], vars(done.stored)[name][rows])
    assert torch.equal(done.c, done.batch.z)
    unit = done.stored.displacement[180:].square().mean().sqrt()  # of the steps in RECENT
    assert done.log.policy.scale == pytest.approx(unit.item())
    torch.set_rng_state(done.random)  # the same draws again: two batches of q, the batch, relabelling, the prior
    torch.randint(120, (50,))
    pick = 299 - torch.randint(120, (50,))  # the latest steps
    assert torch.equal(rows, 299 - torch.randint(300, (64,)))
    torch.rand(64, 1), torch.rand(64, 2)
    others = torch.rand(30, 2) * 2 - 1
    expected = s3.REWARD_SCALE * information(done.q, done.batch.displacement / unit, done.c, others).float()
    torch.testing.assert_close(done.r, expected, atol=1e-3, rtol=1e-3)
    assert done.r.std() > 0.005 and done.log.numbers["reward"] == pytest.approx(expected.mean().item(), abs=1e-4)
    p = D.Independent(D.Normal(done.q(done.stored.z[pick], 1)[0][:, 0], 1.0), 1)
    expected = -p.log_prob(done.stored.displacement[pick] / unit).mean() - math.log(2 * math.pi)  # ours leaves it out
    assert done.log.numbers["model_loss"] == pytest.approx(expected.item(), abs=1e-4)


def test_skill_dynamics_learn_what_skills_do(s3, dads):
    """Robots whose step is a turned skill and noise: the prediction nears it and the information rises."""
    vars(s3).update(MODEL_BATCH=256, BATCH=2, LEARNING_RATE=3e-3, MODEL_UPDATES=4, RECENT=300, WARM_UP=1)
    before = dads(passes=1)
    done = dads(passes=60)
    z, turn = torch.rand(500, 2) * 2 - 1, torch.tensor([[0.0, 0.04], [-0.04, 0.0]])
    for now, bound in ((before, (0.7, 9)), (done, (0, 0.4))):
        wanted = 1.4 * z @ turn  # between once and twice as far
        error = (now.log.policy.scale * now.q(z, 1)[0][:, 0] - wanted).square().mean().sqrt() / wanted.square().mean().sqrt()
        assert bound[0] < error < bound[1]
    d = done.stored.displacement / done.log.policy.scale
    found, first = (information(q, d, done.stored.z, torch.rand(30, 2) * 2 - 1).mean() for q in (done.q, before.q))
    assert found > 0.2 > 3 * first


def test_relabelled_steps_of_dads_have_fresh_skills(s3, dads):
    s3.RELABELLED = 0.5
    done = dads()
    stored = (done.c[:, None] == done.stored.z).all(2).any(1)
    assert 0.3 < stored.float().mean() < 0.7 and done.c.abs().max() <= 1


# ---------------------------------------------------------------- SeCTAR

@pytest.fixture
def sectar(s3, monkeypatch):
    """sectar(prepare, steps) -> one pass of train_sectar over a full replay buffer: 20 steps of 6 robots. A state holds when
    it was made and by whom."""
    torch.manual_seed(0)
    vars(s3).update(METHOD="sectar", ROBOTS=6, SKILL_STEPS=5, EPISODE=10, REPLAY=120, WARM_UP=10, HIDDEN=8, THREADS=1,
                    UPDATES=10 ** 9, UPDATES_PER_STEP=4, BATCH=200, MODEL_BATCH=40, Z_DIM=4, RECENT=60, REWARD_SCALE=0.3,
                    LEARNING_RATE=0.0)

    def run(prepare=lambda log: None, steps=4 * 5 + 3, passes=1):
        def fill(replay):
            replay.added = 6 * steps
            for step in range(steps):
                for robot in range(6):
                    row = replay.read(slice((6 * step + robot) % 120, (6 * step + robot) % 120 + 1))  # a view
                    row.s[0, :2] = torch.tensor([step, robot])
                    row.displacement[0], row.c[0] = 0.05 * torch.randn(2), torch.randn(2)
        done = one_pass(s3, monkeypatch, lambda: s3.train_sectar(None, []), fill, prepare, passes)
        vae = done.log.parts[0]
        done.encoder, done.decoder = vae["encoder"].requires_grad_(False), vae["decoder"].requires_grad_(False)
        return done
    return run


def test_one_pass_of_sectar_pays_the_steps_that_were_asked(sectar):
    done = sectar()
    assert len(done.r) == 800 and len(done.c.unique(dim=0)) > 110  # of 120 steps
    expected = [-0.3 * math.hypot(*(10 * d - c).tolist()) for d, c in zip(done.batch.displacement, done.batch.c)]
    torch.testing.assert_close(done.r, torch.tensor(expected))
    assert torch.equal(done.c, done.batch.c)


def test_sectar_waits_for_the_first_trajectories(sectar):
    assert sectar(steps=4).batch is None and sectar(steps=5).batch is not None


def test_robots_of_sectar_are_asked_for_the_steps_that_are_decoded_from_their_skills(s3, sectar, monkeypatch):
    """Skills of 600 robots, from the prior, each new at its own fifth step; their commands, one displacement after another."""
    vars(s3).update(ROBOTS=600, REPLAY=9000, WARM_UP=1)  # the first step is random
    asked, ages, act = [], [], common.Actor.act
    monkeypatch.setattr(common.Actor, "act", lambda actor, s, c: asked.append(c) or act(actor, s, c))
    age = common.Robots.age
    monkeypatch.setattr(common.Robots, "age", lambda robots: ages.append(age(robots)) or ages[-1])
    done = sectar(steps=0, passes=12)
    stored = done.log.replay.read(torch.arange(12 * 600).view(12, 600))
    t = torch.stack(ages[::2])[:, :, 0] % 5  # each pass asks twice: when it draws, and when it resets
    for z, before, new in zip(stored.z[1:], stored.z[:-1], t[1:] == 0):
        assert torch.equal((z != before).any(1), new)
        assert 0.1 < new.float().mean() < 0.3
    assert stored.z[t == 0].std(0).tolist() == pytest.approx([1] * 4, abs=0.08)
    for z, c, at, kept in zip(stored.z[1:], asked, t[1:].long(), stored.c[1:]):
        torch.testing.assert_close(c, done.decoder(z, 5)[0][torch.arange(600), at])
        assert torch.equal(c, kept)


def test_elbo_of_sectar_equals_torch_distributions(s3, sectar):
    """Of the loss of the model, every draw is repeated here."""
    def prepare(log):
        log.parts[0]["encoder"][4].bias.data += 0.5  # a divergence that counts
        log.parts[0]["decoder"].head[2].bias.data[3] = -8  # below the least deviation
    done = sectar(prepare)
    torch.set_rng_state(done.random)
    last = 6 * 23 - 1 - torch.randint(36, (40,))  # RECENT: the whole trajectory is within the latest 60 steps
    steps = {tuple(s[:2].int().tolist()): d for s, d in zip(done.stored.s, done.stored.displacement)}
    x = torch.stack([torch.stack([steps[int(row) // 6 - 4 + i, int(row) % 6] for i in range(5)]) for row in last]) / 0.1
    mean, log_var = done.encoder(x.reshape(40, 10)).chunk(2, 1)
    q = D.Independent(D.Normal(mean, (0.5 * log_var).exp()), 1)
    z = mean + (0.5 * log_var).exp() * torch.randn(40, 4)
    decoded, log_var = done.decoder(z, 5)
    p = D.Normal(decoded, (0.5 * log_var).exp().clamp(min=0.1))  # at least 1 cm
    kl = D.kl_divergence(q, D.Independent(D.Normal(torch.zeros(40, 4), 1.0), 1))
    constant = 10 * 0.5 * math.log(2 * math.pi)  # ours leaves it out
    expected = kl - p.log_prob(x).sum((1, 2)) - constant
    assert done.log.numbers["model_loss"] == pytest.approx(expected.mean().item(), abs=1e-3)
