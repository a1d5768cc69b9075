"""The package as its users call it. Scenes are small; the bits are those of the command line's tests."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import loomtree

ROOT = Path(__file__).resolve().parents[2]

FLAG = {
    "name": "flag",
    "resolution": 600,
    "simulation": {"step_s": 0.004, "steps_per_frame": 5, "frames": 4},
    "air": {"wind_m_s": np.array([9.0, 0.5, 3.5]), "density_kg_m3": 1.2},
    "cloth": [{"name": "flag", "sheet": {"size_m": [3.0, 2.0]}, "origin_m": [0.0, 1.0, 0.0], "fabric": "nylon"}],
    "pin": [{"edge": "left"}],
}


def test_a_simulation_has_the_same_bits_for_any_number_of_workers():
    hashes = []
    for workers in (1, 3):
        with loomtree.Simulation(FLAG, workers=workers, executor="cpu", threads=1) as flag:
            flag.advance(10)
            hashes.append(flag.state_hash)
            assert flag.step == 10 and flag.time_s == pytest.approx(0.04)
    assert hashes[0] == hashes[1]


def test_arrays_are_those_of_the_mesh_and_stay_when_the_simulation_goes_on():
    flag = loomtree.Simulation(FLAG, executor="cpu")
    start = flag.positions
    assert start.dtype == np.float32 and start.shape == (start.shape[0], 3)
    assert flag.triangles.dtype == np.uint32 and flag.triangles.max() == len(start) - 1
    assert flag.positions is start, "handed over once, not copied"
    assert np.allclose(np.ptp(start, axis=0)[:2], [3.0, 2.0], atol=1e-6)
    assert not flag.velocities.any()
    before = start.copy()
    flag.advance(5)
    assert np.array_equal(start, before)
    moved = flag.positions
    # Without pins and air the mean velocity is that of the mean of positions.
    assert np.abs(moved - before).max() > 1e-3
    pinned = before[:, 0] < 1e-6
    assert pinned.sum() > 3 and np.array_equal(moved[pinned], before[pinned])
    assert flag.pieces == [loomtree.Piece("flag", slice(0, len(start)), slice(0, len(flag.triangles)))]
    flag.close()
    assert np.array_equal(start, before), "arrays outlive the simulation"
    with pytest.raises(RuntimeError, match="closed"):
        flag.advance(1)


def test_free_fall_falls_as_it_must():
    scene = {
        "name": "fall",
        "resolution": 200,
        "simulation": {"step_s": 0.002, "steps_per_frame": 1, "frames": 1},
        "cloth": [{"name": "sheet", "sheet": {"size_m": [1.0, 1.0]}, "fabric": "cotton"}],
    }
    with loomtree.Simulation(scene, executor="cpu") as sheet:
        up = sheet.velocities
        sheet.advance(50)
        fallen = sheet.velocities - up
    # Implicit Euler: v = -g t, exactly, in whichever direction is up.
    speed = np.linalg.norm(fallen.mean(axis=0))
    assert speed == pytest.approx(9.81 * 0.1, rel=2e-3)


def test_progress_sees_every_step_and_can_stop():
    with loomtree.Simulation(FLAG, executor="cpu") as flag:
        seen = []
        flag.advance(4, progress=seen.append)
        assert [step["step"] for step in seen] == [1, 2, 3, 4]
        assert all(step["converged"] and step["iterations"] > 0 for step in seen)
        flag.advance(10_000, progress=lambda step: step["step"] < 6)
        assert 6 <= flag.step < 10_000

        def fails(step):
            raise KeyError("mine")

        with pytest.raises(KeyError, match="mine"):
            flag.advance(10_000, progress=fails)
        step = flag.step
        flag.advance(1)
        assert flag.step == step + 1, "it goes on after that"


def test_ctrl_c_ends_a_simulation_and_a_run(tmp_path):
    program = (
        "import os, signal, sys, threading, loomtree\n"
        "sys.path.insert(0, sys.argv[1])\n"
        "from test_loomtree import FLAG\n"
        "threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT)).start()\n"
        "try:\n"
        "    if sys.argv[2] == 'step':\n"
        "        loomtree.Simulation(FLAG, executor='cpu').advance(10_000_000)\n"
        "    else:\n"
        "        loomtree.run(FLAG, sys.argv[3], executor='cpu', frames=1_000_000)\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted')\n"
    )
    for what in ("step", "run"):
        words = [sys.executable, "-c", program, str(Path(__file__).parent), what, str(tmp_path / what)]
        ended = subprocess.run(words, capture_output=True, text=True, timeout=60, cwd=tmp_path)
        assert ended.stdout == "interrupted\n" and ended.returncode == 0, ended.stderr
    assert loomtree.Run(tmp_path / "run").report["status"] == "stopped"


def test_set_changes_fields():
    with loomtree.Simulation(FLAG, executor="cpu", set={"simulation.step_s": 0.001, "air.wind_m_s": [0, 0, 0]}) as flag:
        assert flag.step_s == 0.001


@pytest.mark.parametrize(
    "change, sentence",
    [
        ({"simulation": {"step_s": -1.0}}, "step_s"),
        ({"cloth": [{"name": "a", "sheet": {"size_m": [1.0, 1.0]}, "fabric": "tinfoil"}]}, "tinfoil"),
        ({"windd": {}}, "windd"),
        ({"cloth": [{"name": None}]}, r"cloth\.0\.name"),
    ],
)
def test_wrong_scenes_are_refused_in_a_sentence(change, sentence):
    with pytest.raises(ValueError, match=sentence):
        loomtree.Simulation({**FLAG, **change})


def test_wrong_options_are_refused():
    with pytest.raises(ValueError, match="workers"):
        loomtree.Simulation(FLAG, workers=0)
    with pytest.raises(ValueError, match="quantum"):
        loomtree.Simulation(FLAG, executor="quantum")
    with pytest.raises(ValueError, match="missing.toml"):
        loomtree.Simulation("missing.toml")


def test_a_run_is_written_read_resumed_and_has_the_bits_of_a_simulation(tmp_path):
    frames = []
    run = loomtree.run(
        FLAG,
        tmp_path / "flag",
        workers=2,
        executor="cpu",
        keep_states="frames",
        progress=lambda frame, of: frames.append((frame, of)),
    )
    assert run.report["status"] == "done" and run.frames == [0, 1, 2, 3, 4]
    assert frames[-1] == (4, 4)
    assert run.states() == [0, 5, 10, 15, 20]
    with loomtree.Simulation(FLAG, executor="cpu") as flag:
        flag.advance(20)
        assert run.state().state_hash == flag.state_hash == run.report["frames"][-1]["state_hash"]
        assert np.array_equal(run.state().velocities, flag.velocities)
        assert np.array_equal(run.positions(), flag.positions)
        assert np.array_equal(run.triangles(), flag.triangles)
    assert run.obstacles() is None
    with pytest.raises(ValueError, match="no frame 9"):
        run.positions(9)
    with pytest.raises(ValueError, match="no state of step 7"):
        run.state(7)
    with pytest.raises(ValueError):
        loomtree.run(FLAG, tmp_path / "flag")

    stopped = loomtree.run(
        FLAG, tmp_path / "stopped", executor="cpu", frames=40, checkpoint_every=1, progress=lambda frame, of: frame < 2
    )
    assert stopped.report["status"] == "stopped" and 2 <= stopped.frames[-1] < 40
    whole = loomtree.resume(tmp_path / "stopped", workers=3)
    assert whole.report["status"] == "done" and whole.frames[-1] == 40
    assert whole.report["frames"][4]["state_hash"] == run.report["frames"][4]["state_hash"]


def test_point_caches_are_mapped(tmp_path):
    run = loomtree.run(FLAG, tmp_path / "a", executor="cpu", formats="pc2,ply", frames=2)
    mapped = run.positions(1)
    assert isinstance(mapped, np.memmap)
    assert np.array_equal(mapped, run._read(1, False)[0])
    assert np.array_equal(run.positions(-1), run.positions(2))


def test_a_folder_without_a_run_is_refused(tmp_path):
    with pytest.raises(ValueError, match="report.json"):
        loomtree.Run(tmp_path)


def test_a_split_shot_is_a_run(tmp_path):
    scene = {**FLAG, "resolution": 2000}
    run = loomtree.run(scene, tmp_path / "split", executor="cpu", segments=2)
    assert run.report["status"] == "done" and run.frames == [0, 1, 2, 3, 4]


def test_shipped_scenes_load():
    with loomtree.Simulation(ROOT / "scenes/sphere.toml", resolution=500, executor="cpu") as sphere:
        sphere.advance(1)
        assert len(sphere.triangles) > 300
    with pytest.raises(ValueError, match="loomtree.run"):
        loomtree.Simulation(ROOT / "scenes/skirt.toml")


@pytest.mark.parametrize("rows, workers", [(30, 1), (301, 2), (2000, 3)])
def test_systems_are_solved(rows, workers):
    sparse = pytest.importorskip("scipy.sparse")
    linalg = pytest.importorskip("scipy.sparse.linalg")
    generator = np.random.default_rng(7)
    noise = sparse.random(rows, rows, density=4 / rows, random_state=generator, format="csr")
    matrix = noise @ noise.T + sparse.diags(np.full(rows, 2.0))
    b = generator.normal(size=rows)
    x, figures = loomtree.solve(matrix, b, workers=workers, rtol=1e-8, executor="cpu")
    assert figures["converged"] and figures["relative_residual"] <= 1e-8
    assert np.linalg.norm(matrix @ x - b) <= 1.01e-8 * np.linalg.norm(b)
    assert np.allclose(x, linalg.spsolve(matrix.tocsc(), b), rtol=0, atol=1e-6)


def test_systems_that_cannot_be_solved_are_refused():
    sparse = pytest.importorskip("scipy.sparse")
    with pytest.raises(ValueError, match="symmetric"):
        loomtree.solve(sparse.csr_matrix(np.array([[2.0, 1.0], [0.0, 2.0]])))
    with pytest.raises(ValueError, match="rows as columns"):
        loomtree.solve(sparse.csr_matrix(np.ones((2, 3))))
    with pytest.raises(ValueError, match="rhs"):
        loomtree.solve(sparse.eye(3).tocsr(), np.ones(4))


def test_schedules_of_topologies():
    plan = loomtree.schedule(ROOT / "topology/pcie_8.toml", kind="fat-tree")
    assert plan.kind == "fat-tree" and len(plan.queues) == 8
    for rank, queue in enumerate(plan.queues):
        assert len(queue) == 7
        assert sorted(vector for _, vector in queue) == [other for other in range(8) if other != rank]
    assert plan.total_s == pytest.approx(sum(plan.stage_s))
    best = loomtree.schedule(ROOT / "topology/pcie_8.toml").total_s
    for kind in ("fat-tree", "ring", "direct"):
        assert loomtree.schedule(ROOT / "topology/pcie_8.toml", kind=kind).total_s >= best
    with pytest.raises(ValueError, match="kind"):
        loomtree.schedule(ROOT / "topology/pcie_8.toml", kind="telepathy")
