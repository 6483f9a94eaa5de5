"""Stage 4: geometry against dense sampling, walls that touch, Algorithm 2 against loops, the command line."""
import common
import numpy as np
import pytest
import torch
from conftest import cli


def test_distances_are_the_papers(s4):
    assert np.hypot(*np.subtract(s4.GOAL, s4.START)) == pytest.approx(26.8, abs=0.05)
    assert sum(np.subtract(s4.GOAL, s4.START)) == 36  # A.1.4: the effective distance


def test_collisions_agree_with_dense_sampling(s4):
    rng = np.random.default_rng(0)
    path = torch.from_numpy(rng.uniform([-8, -8], [33, 20], (400, 4, 2)).astype(np.float32))
    walls = s4.MAZE["maze1"]
    found = s4.collides(path, walls)
    t = torch.linspace(0, 1, 2001)[:, None]
    disagreements = 0
    for n in range(400):
        for k in range(3):
            p = path[n, k] + t * (path[n, k + 1] - path[n, k])
            hit = any(((p[:, 0] >= x0 - 1) & (p[:, 0] <= x1 + 1) & (p[:, 1] >= y0 - 1) & (p[:, 1] <= y1 + 1)).any() for x0, x1, y0, y1 in walls)
            disagreements += hit != bool(found[n, k])
    assert disagreements <= 2 and 0.1 < found.float().mean() < 0.95  # sampling misses a corner cut shorter than its step


def test_no_straight_line_but_some_path_solves_each_maze(s4):
    for maze, way in (("maze1", [(0, 0), (19.5, 2), (24, 12)]), ("maze2", [(0, 0), (6, 1), (10, 2), (15.2, 9.5), (19, 10), (24, 12)])):
        walls = s4.MAZE[maze]
        assert s4.collides(torch.tensor([[s4.START, s4.GOAL]]), walls).any()
        assert not s4.collides(torch.tensor([way], dtype=torch.float32), walls).any()


def test_walls_stop_the_ant_and_the_sensor_feels_it(s4):
    robots = common.Robots(s4.maze_spec([(1.2, 2.2, -5, 5)]), 2)
    touch = robots.batch.bind("sensordata")
    robots.qpos[1, 0] = -20
    felt = np.zeros(2, bool)
    for _ in range(60):
        robots.qvel[:, 0] = 1  # pushed along x, no faster than it walks
        robots.step(np.zeros((2, 8)))
        felt |= touch[:, 0] > 0
    assert felt.tolist() == [True, False]
    assert robots.qpos[0, 0] < 1.2 and robots.qpos[1, 0] > -20 + 2


def test_scaled_path_is_algorithm_2_line_by_line(s4):
    torch.manual_seed(0)
    decoder, z, start = common.Decoder(3), torch.randn(3, 2, 3), torch.tensor([1.0, -2.0])
    path = s4.scaled_path(decoder, None, start, z)
    for n in range(3):
        state, expected = start.clone(), [start]
        for j in range(2):
            for delta in decoder(z[n, j:j + 1], 5)[0][0]:
                state = state + 0.1 * 40 * delta
                expected.append(state)
        torch.testing.assert_close(path[n], torch.stack(expected), atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("sparse", [False, True])
@pytest.mark.parametrize("objective", ["final", "sum"])
def test_plan_is_the_best_of_its_samples(s4, sparse, objective):
    torch.manual_seed(0)
    decoder, start, walls = common.Decoder(3), torch.tensor([20.0, 8.0]), s4.MAZE["maze1"]
    s4.SAMPLES = 200
    skill, path = s4.plan(decoder, 0.3, start, 2, walls, sparse, objective, torch.Generator().manual_seed(5))
    assert skill.abs().max() <= 1.5 and skill[0] >= 0
    z = 1.5 * (2 * torch.rand(200, 2, 3, generator=torch.Generator().manual_seed(5)) - 1)
    z[..., 0] = z[..., 0].abs()
    scores = []
    for candidate in z:
        p = s4.scaled_path(decoder, 0.3, start, candidate[None])[0]
        r = [-(q - torch.tensor(s4.GOAL)).norm() for q in p[1:]]
        r = [5.0 * (abs(v) < 5) for v in r] if sparse else r
        scores.append((r[-1] if objective == "final" else sum(r)) - 100 * s4.collides(p[None], walls).sum())
    best = int(torch.tensor([float(s) for s in scores]).argmax())
    torch.testing.assert_close(skill, z[best, 0])
    torch.testing.assert_close(path, s4.scaled_path(decoder, 0.3, start, z[best:best + 1])[0])


def test_command_line_prints_the_table_and_writes_everything(tmp_path):
    flags = ["--out", tmp_path, "--trials", 2, "--samples", 50]
    done = cli("04_mpc_maze", *flags, "--episode", 400)
    assert done.returncode == 0, done.stderr
    rows = common.read_csv(tmp_path / "results/mazes.csv")
    assert len(rows) == 2 * 2 * 2 * 2 and {row["maze"] for row in rows} == {"maze1", "maze2"}
    assert all(float(row["min_distance"]) <= float(row["final_distance"]) for row in rows)
    assert all(f"| {maze} | {reward} | {p} | final |" in done.stdout for maze in ("maze1", "maze2") for reward in ("dense", "sparse")
               for p in ("relation", "decoder"))
    for name in ("fig06_mazes.png", "fig08_mpc_examples.png", "maze1.gif", "maze2.gif"):
        assert (tmp_path / "figures" / name).stat().st_size > 10_000
    again = cli("04_mpc_maze", *flags, "--episode", 400, "--animate", "false")  # same seed, same numbers
    assert again.returncode == 0
    strip = lambda rs: [{k: v for k, v in r.items() if k != "planning_ms"} for r in rs]  # noqa: E731
    assert strip(common.read_csv(tmp_path / "results/mazes.csv")) == strip(rows)


def test_without_a_gl_library_the_gif_is_drawn_by_matplotlib(tmp_path):
    done = cli("04_mpc_maze", "--out", tmp_path, "--trials", 1, "--samples", 5, "--episode", 200, "--mazes", "maze1", "--rewards", "dense",
               "--predictions", "relation", MUJOCO_GL="disable")
    assert done.returncode == 0 and "drawn by matplotlib" in done.stdout, done.stderr
    assert (tmp_path / "figures/maze1.gif").stat().st_size > 10_000
