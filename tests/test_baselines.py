"""Stage 3, the baselines: one pass of each training loop over a replay buffer made by hand, against
torch.distributions and plain loops.
Their trainings from the command line, and that these resume with the same bits: test_policy.py."""
import math
from types import SimpleNamespace

import common
import pytest
import torch
from torch import distributions as D


def gaussian(q, z):
    """q(. | z) by torch.distributions, in trajectory units; its deviation is at least 1 cm."""
    mean, log_var = (v.detach()[:, 0] for v in q(z, 1))
    return D.Independent(D.Normal(mean, (0.5 * log_var).exp().clamp(min=0.1)), 1)


class Sac:
    """Keeps the batches that it is given; its inputs are state and command side by side."""
    actor = SimpleNamespace(inputs=lambda s, c: torch.cat([s, c], 1))

    def __init__(self):
        self.updates, self.batches = 0, []
        self.critic_adam = self.actor_adam = SimpleNamespace(param_groups=[])

    def update(self, x, a, x2, r):
        self.batches.append((x, x2, r))
        self.updates += 1
        return 0.0

    def kept(self):
        return (torch.cat(part) for part in zip(*self.batches))


# ---------------------------------------------------------------- DADS

@pytest.fixture
def dads(s3):
    """A run whose steps are drawn from 300 stored ones; q has means and variances unlike those at the start."""
    torch.manual_seed(0)
    vars(s3).update(METHOD="dads", PRIOR_SAMPLES=30, RELABELLED=0.0, UPDATES_PER_STEP=1, UPDATES=1, BATCH=64,
                    MODEL_BATCH=50)
    q = common.Decoder(2, 2, 16)
    with torch.no_grad():
        q.head[2].weight *= 10
        q.head[2].bias[2] = -6  # below the least deviation
    stored = [torch.randn(300, n) for n in (27, 8, 27)] + [0.05 * torch.randn(300, 2), torch.rand(300, 2) * 2 - 1]

    def sample(n, recent=None):
        pick = torch.randint(300, (n,))
        return [part[pick] for part in stored]
    run = SimpleNamespace(decoder=q, sac=Sac(), sample=sample, z=None, renew=lambda z: None, warm=lambda: True,
                          act=lambda z: None, collect=lambda: None, learn=lambda *steps: s3.Run.learn(run, *steps),
                          adam=torch.optim.SGD(q.parameters(), lr=0.0), losses={}, stored=stored)
    return run


def information(q, displacement, z, others):
    """log(L + 1) - log(1 + sum_i exp(log q(x | z_i) - log q(x | z))), one displacement at a time."""
    x, found = displacement / 0.1, []
    for i in range(len(x)):
        own = gaussian(q, z[i:i + 1]).log_prob(x[i:i + 1])
        away = (gaussian(q, others).log_prob(x[i].expand(len(others), 2)) - own).clamp(-50, 50).double()
        found.append(math.log(len(others) + 1) - math.log1p(away.exp().sum().item()))
    return torch.tensor(found)


def test_one_pass_of_dads_learns_q_and_pays_the_information(s3, dads):
    torch.manual_seed(1)
    s3.train_dads(dads)
    q = dads.decoder
    x, x2, r = dads.sac.kept()
    rows = (x[:, None, :27] == dads.stored[0]).all(2).nonzero()[:, 1]  # which of the stored steps these are
    assert torch.equal(x[:, 27:], dads.stored[4][rows])
    assert torch.equal(x2, torch.cat([dads.stored[2][rows], x[:, 27:]], 1))
    torch.manual_seed(1)  # the same draws again: skills of the robots, q's batch, the batch, relabelling, the prior
    torch.rand(s3.ROBOTS, 2)
    pick = torch.randint(300, (50,))
    torch.randint(300, (64,))
    torch.rand(64, 1), torch.rand(64, 2)
    others = torch.rand(30, 2) * 2 - 1
    expected = s3.REWARD_SCALE * information(q, dads.stored[3][rows], x[:, 27:], others).float()
    torch.testing.assert_close(r, expected, atol=1e-3, rtol=1e-3)
    assert r.std() > 0.01
    displacement, z = dads.stored[3][pick], dads.stored[4][pick]
    expected = -gaussian(q, z).log_prob(displacement / 0.1).mean() - math.log(2 * math.pi)  # ours leaves it out
    assert dads.losses["model_loss"] == pytest.approx(expected.item(), abs=1e-4)


def test_skill_dynamics_learn_what_skills_do(s3, dads):
    """Robots whose step is a turned skill and noise: the prediction nears it and the information rises."""
    turn = torch.tensor([[0.0, 0.04], [-0.04, 0.0]])
    vars(s3).update(UPDATES=150, MODEL_BATCH=256, BATCH=2)
    dads.stored[3][:] = dads.stored[4] @ turn + 0.003 * torch.randn(300, 2)
    q = dads.decoder = common.Decoder(2, 2, 64)
    dads.adam = torch.optim.Adam(q.parameters(), lr=3e-3)
    s3.train_dads(dads)
    z = torch.rand(500, 2) * 2 - 1
    assert (0.1 * q(z, 1)[0][:, 0] - z @ turn).square().mean().sqrt() < 0.4 * (z @ turn).square().mean().sqrt()
    found = information(q, dads.stored[3], dads.stored[4], torch.rand(30, 2) * 2 - 1)
    assert found.mean() > 0.3


# ---------------------------------------------------------------- SeCTAR

@pytest.fixture
def sectar(s3):
    """A run with a full replay buffer: 4 trajectories of 6 robots, 5 steps each. A state holds who made it and when."""
    torch.manual_seed(0)
    vars(s3).update(METHOD="sectar", ROBOTS=6, SKILL_STEPS=5, Z_DIM=4, RECENT=60, MODEL_BATCH=40, RELABELLED=0.0,
                    UPDATES_PER_STEP=4, UPDATES=1, BATCH=200, REWARD_SCALE=0.3)
    run = SimpleNamespace(widths=(3, 1, 3, 2, 4), steps=4 * 5 + 3, sac=Sac(), losses={}, warm=lambda: True,
                          z=torch.zeros(6, 4), renew=lambda z: None, act=lambda c: None, collect=lambda: None,
                          learn=lambda *steps: s3.Run.learn(run, *steps))
    run.model = dict(encoder=common.layers(2 * 5, 8, 2 * 4), decoder=common.Decoder(4, 2, 8))
    run.decoder = run.model["decoder"]
    run.replay = torch.zeros(4 * 5 * 6, 13)
    skills = torch.randn(5, 6, 4)
    skills[:, :2, :2] = 3 * torch.nn.functional.normalize(skills[:, :2, :2], dim=2)
    skills[:, :2, 3] = s3.EXPLORER  # two of six robots explore
    for step in range(run.steps):
        for robot in range(6):
            s = torch.tensor([step, robot, 0.0])
            run.replay[(6 * step + robot) % 120] = torch.cat(
                [s, torch.zeros(1), s + torch.tensor([1.0, 0, 0]), 0.05 * torch.randn(2), skills[step // 5, robot]])
    run.adam = torch.optim.SGD([p for net in run.model.values() for p in net.parameters()], lr=0.0)
    return run


def test_one_pass_of_sectar_pays_the_place_where_a_trajectory_ends(s3, sectar):
    sectar.model["encoder"][-1].weight.data[4:] = 0  # q(z | tau) without noise
    sectar.model["encoder"][-1].bias.data[4:] = -40
    s3.train_sectar(sectar)
    stored = {(int(row[0]), int(row[1])): row for row in sectar.replay}
    x, x2, r = sectar.sac.kept()
    explored = 0
    for one, after, found in zip(x, x2, r):
        step, robot = int(one[0]), int(one[1])
        t, z = step % 5, stored[step, robot][9:]
        first = step - t
        assert first + 4 < sectar.steps  # a trajectory that is whole
        path = torch.stack([stored[first + i, robot][7:9] for i in range(5)]) / 0.1
        if robot < 2:  # the explorer: its command is its own, its decoded path is the encoder's
            explored += 1
            torch.testing.assert_close(one[3:], z[:2])
            mean = sectar.model["encoder"](path.flatten())[:4].detach()
            miss = path - sectar.decoder(mean[None], 5)[0][0].detach()
            assert found.item() == pytest.approx(0.3 * float(miss[t] @ z[:2]) / 3, abs=1e-5)
            continue
        decoded = sectar.decoder(z[None], 5)[0][0].detach()
        miss = path - decoded
        end = miss.sum(0) / miss.sum(0).norm()
        assert found.item() == pytest.approx(-0.3 * float(miss[t] @ end), abs=1e-5)
        torch.testing.assert_close(one[3:], decoded[t])  # the command of now, and of the next step
        torch.testing.assert_close(after[3:], decoded[min(4, t + 1)])
    assert 0.1 < explored / len(x) < 0.6


def test_sectar_waits_for_the_first_whole_trajectories(s3, sectar):
    sectar.steps, sectar.collect = 4, lambda: vars(sectar.sac).update(updates=1)
    s3.train_sectar(sectar)
    assert not sectar.sac.batches


def test_elbo_of_sectar_equals_torch_distributions(s3, sectar):
    """Without an explorer all trajectories teach the model; of its loss, every draw is repeated here."""
    s3.EXPLORE = 0.0
    with torch.no_grad():
        sectar.model["encoder"][4].bias += 0.5  # a divergence that counts
    torch.manual_seed(3)
    s3.train_sectar(sectar)
    torch.manual_seed(3)
    torch.randn(6, 4), torch.rand(6)
    back, robot = torch.randint(2, (40,)), torch.randint(6, (40,))  # RECENT: 60 steps are the two latest trajectories
    rows = (3 - back) % 4 * 30 + robot
    x = torch.stack([sectar.replay[rows + 6 * i, 7:9] for i in range(5)], 1) / 0.1
    mean, log_var = sectar.model["encoder"](x.reshape(40, 10)).detach().chunk(2, 1)
    q = D.Independent(D.Normal(mean, (0.5 * log_var).exp()), 1)
    z = mean + (0.5 * log_var).exp() * torch.randn(40, 4)
    decoded, log_var = (v.detach() for v in sectar.decoder(z, 5))
    p = D.Normal(decoded, (0.5 * log_var).exp().clamp(min=s3.FLOOR_END / 0.1))
    kl = D.kl_divergence(q, D.Independent(D.Normal(torch.zeros(40, 4), 1.0), 1))
    constant = 10 * 0.5 * math.log(2 * math.pi)  # ours leaves it out
    expected = s3.KL_WEIGHT * kl - p.log_prob(x).sum((1, 2)) - constant
    assert sectar.losses["model_loss"] == pytest.approx(expected.mean().item(), abs=1e-3)
