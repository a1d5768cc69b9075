"""Loomtree: cloth that never passes through itself, on the workers of this process.

Step a scene and look at it::

    import loomtree

    with loomtree.Simulation("scenes/flag.toml", workers=2, resolution=2000) as flag:
        flag.advance(25)
        print(flag.time_s, flag.positions.shape, flag.state_hash)

Make a run directory, as ``loomtree run`` does, and read it::

    run = loomtree.run("scenes/flag.toml", out="out/flag", workers=2, resolution=2000, frames=10)
    print(run.report["status"], run.positions(10).max(axis=0))

Solve a system, plan transfers::

    x, figures = loomtree.solve(matrix, rhs, workers=2, rtol=1e-6)
    plan = loomtree.schedule("topology/pcie_8.toml", bytes=1.8e6)

Units are SI: meters, seconds, kilograms. Wrong input raises ``ValueError`` with one sentence, a failure
``RuntimeError``. Ctrl-C stops after the current step.
"""

from __future__ import annotations

import json as _json
import os as _os
from pathlib import Path as _Path
from typing import Any, Callable, Dict, List, Mapping, NamedTuple, Optional, Sequence, Tuple, Union

import numpy as _np

from . import _loomtree

__version__: str = _loomtree.__version__
__all__ = ["Piece", "Run", "Schedule", "Simulation", "State", "resume", "run", "schedule", "scene_text", "solve"]

PathLike = Union[str, "_os.PathLike[str]"]
#: A scene file (TOML), or the scene itself as a dict with the same tables.
SceneLike = Union[PathLike, Mapping[str, Any]]


class Piece(NamedTuple):
    """A piece of cloth of a scene."""

    #: Name in the scene.
    name: str
    #: Its vertices.
    vertices: slice
    #: Its triangles.
    triangles: slice


class State(NamedTuple):
    """A state that a run has kept."""

    #: Steps made.
    step: int
    #: Seconds.
    time_s: float
    #: (vertices, 3) float32, meters, relative to the origin of the scene.
    positions: _np.ndarray
    #: (vertices, 3) float32, m/s.
    velocities: _np.ndarray
    #: As in report.json: equal for equal bits.
    state_hash: str


class Schedule(NamedTuple):
    """Transfer stages of the GPUs of a topology."""

    #: How they were made: ``fat-tree``, ``ring``, ``direct`` or ``best``.
    kind: str
    #: By rank, by stage: the rank that it receives from, and whose sub-vector it receives.
    queues: List[List[Tuple[int, int]]]
    #: Modelled, not measured: seconds by which a stage is complete later than the one before.
    stage_s: List[float]
    #: Modelled, not measured: seconds until every rank holds everything.
    total_s: float


class Simulation:
    """A scene on the workers of this process, advanced step by step. Same bits for any number of workers.

    Args:
        scene: a scene file, or a dict with its tables (``{"name": .., "cloth": [{..}], ..}``).
        workers: ranks, each with its block of rows; threads of this process.
        resolution: triangles of the scene's sheets; the scene's own if left out.
        executor: ``"auto"``, ``"cpu"`` or ``"gpu"``.
        threads: threads of each worker on the cpu executor; the cores shared out if left out.
        set: fields of the scene to change, by dotted name: ``{"simulation.friction": 0.5}``.
        start_from: a run directory to take positions and velocities from, ``"out/flag"`` or ``"out/flag:100"``.
        untangle: untangle a start that crosses instead of refusing it.
        base: folder that paths within a dict are relative to; the current one if left out.

    Raises:
        ValueError: what is wrong with the scene or an option, in one sentence.
    """

    def __init__(
        self,
        scene: SceneLike,
        *,
        workers: int = 1,
        resolution: Optional[int] = None,
        executor: str = "auto",
        threads: Optional[int] = None,
        set: Optional[Mapping[str, Any]] = None,
        start_from: Optional[PathLike] = None,
        untangle: bool = False,
        base: Optional[PathLike] = None,
    ) -> None:
        options = _options(
            workers=workers,
            resolution=resolution,
            executor=executor,
            threads=threads,
            set=_settings(set),
            start_from=None if start_from is None else _os.fspath(start_from),
            untangle=untangle,
        )
        if isinstance(scene, Mapping):
            text = scene_text(scene)
            path = _Path(base or ".") / (str(scene.get("name", "scene")) + ".toml")
        else:
            text, path = None, _Path(scene)
        self._native = _loomtree.Simulation(text, path, options)

    def advance(self, steps: int = 1, progress: Optional[Callable[[Dict[str, Any]], Any]] = None) -> None:
        """Makes steps.

        Args:
            steps: how many; a frame has ``steps_per_frame`` of them.
            progress: called after every step with its figures (``step``, ``time_s``, ``iterations``, ``converged``,
                ``substeps``, ``contacts``, ``smallest_gap_m``, ``wall_s``). The workers go on meanwhile. If it returns
                False or raises, the simulation stops after the step under way.

        Raises:
            RuntimeError: a step failed; the simulation cannot go on.
        """
        self._native.advance(steps, progress)

    @property
    def name(self) -> str:
        """Name of the scene."""
        return self._native.name

    @property
    def step(self) -> int:
        """Steps made."""
        return self._native.step

    @property
    def time_s(self) -> float:
        """Simulated time, seconds."""
        return self._native.time_s

    @property
    def step_s(self) -> float:
        """Length of a step, seconds."""
        return self._native.step_s

    @property
    def steps_per_frame(self) -> int:
        """Steps of a frame."""
        return self._native.steps_per_frame

    @property
    def frames(self) -> int:
        """Frames that the scene asks for, after frame 0. ``advance`` may go further."""
        return self._native.frames

    @property
    def origin_m(self) -> _np.ndarray:
        """(3,) float64, meters: the point that positions are relative to; 0 but for scenes far from it."""
        return _np.asarray(self._native.origin_m)

    @property
    def pieces(self) -> List[Piece]:
        """The pieces of cloth, in the order of the scene."""
        return [Piece(name, slice(*vertices), slice(*triangles)) for name, vertices, triangles in self._native.pieces]

    @property
    def triangles(self) -> _np.ndarray:
        """(triangles, 3) uint32: vertices of every triangle."""
        return self._native.triangles

    @property
    def positions(self) -> _np.ndarray:
        """(vertices, 3) float32, meters, relative to ``origin_m``. The array is handed over without a copy and stays as
        it is when the simulation goes on."""
        return self._native.positions

    @property
    def velocities(self) -> _np.ndarray:
        """(vertices, 3) float32, m/s; like ``positions``."""
        return self._native.velocities

    @property
    def state_hash(self) -> str:
        """Hash of the bits of the whole state, as in report.json."""
        return self._native.state_hash

    def close(self) -> None:
        """Ends the workers. Arrays that were handed out stay."""
        self._native.close()

    def __enter__(self) -> "Simulation":
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"<loomtree.Simulation {self.name}: {len(self.triangles)} triangles, step {self.step}>"


class Run:
    """A run directory, finished or not.

    Args:
        path: the folder.

    Raises:
        ValueError: there is no run.
    """

    def __init__(self, path: PathLike) -> None:
        self.path = _Path(path)
        if not (self.path / "report.json").is_file():
            raise ValueError(f"{self.path}: no report.json, so this is no run directory")

    @property
    def report(self) -> Dict[str, Any]:
        """report.json as it is now: frames with their hashes, steps with their figures, machine, status."""
        return _json.loads((self.path / "report.json").read_text())

    @property
    def frames(self) -> List[int]:
        """Numbers of the frames that are there, ascending."""
        return _loomtree.frames(self.path)

    def positions(self, frame: int = -1) -> _np.ndarray:
        """(vertices, 3) float32, meters: the cloth at a frame; negative numbers count from the last one.

        A run with ``formats="pc2"`` is mapped into memory, not read: (vertices, 3) without a copy.
        """
        mapped = self._mapped()
        if mapped is not None:
            first, samples = mapped
            frame = frame if frame >= 0 else first + len(samples) + frame
            if not first <= frame < first + len(samples):
                raise ValueError(f"{self.path}: there is no frame {frame}")
            return samples[frame - first]
        return self._read(frame, False)[0]

    def triangles(self, frame: int = -1) -> _np.ndarray:
        """(triangles, 3) uint32. Of a frame, because cloth that is sewn has another mesh once it is merged."""
        return self._read(frame, False)[1]

    def obstacles(self, frame: int = -1) -> Optional[Tuple[_np.ndarray, _np.ndarray]]:
        """Positions and triangles of all obstacles at a frame, or None."""
        return self._read(frame, True)

    def states(self) -> List[int]:
        """Steps of the states that are kept: checkpoints, and those of ``keep_states``."""
        return [step for step, _ in _loomtree.kept_states(self.path)]

    def state(self, step: Optional[int] = None) -> State:
        """A kept state with its velocities: that after ``step``, or the newest one."""
        kept = dict(_loomtree.kept_states(self.path))
        wanted = max(kept, default=None) if step is None else step
        if wanted not in kept:
            there = ", ".join(str(step) for step in kept) or "none"
            raise ValueError(f"{self.path}: no state of step {step} is kept (there are: {there}); run with keep_states")
        return State(*_loomtree.read_state(kept[wanted]))

    def _read(self, frame: int, obstacles: bool) -> Any:
        if frame < 0:
            numbers = self.frames
            if frame < -len(numbers):
                raise ValueError(f"{self.path}: there are only {len(numbers)} frames")
            frame = numbers[frame]
        return _loomtree.read_frame(self.path, frame, obstacles)

    def _mapped(self) -> Optional[Tuple[int, _np.ndarray]]:
        """First frame and (frames, vertices, 3) of a point cache that holds all frames."""
        path = self.path / "cloth.pc2"
        if not path.is_file() or (self.path / "cloth_2.pc2").is_file():
            return None
        header = _np.fromfile(path, dtype="<u1", count=32)
        if bytes(header[:12]) != b"POINTCACHE2\0":
            return None
        vertices = int(header[16:20].view("<i4")[0])
        first = int(header[20:24].view("<f4")[0])
        samples = int(header[28:32].view("<i4")[0])
        shape = (samples, vertices, 3)
        return first, _np.memmap(path, dtype="<f4", mode="r", offset=32, shape=shape)

    def __repr__(self) -> str:
        return f"<loomtree.Run {self.path}: {self.report['status']}>"


def run(
    scene: SceneLike,
    out: PathLike,
    *,
    workers: int = 1,
    resolution: Optional[int] = None,
    frames: Optional[int] = None,
    executor: str = "auto",
    threads: Optional[int] = None,
    set: Optional[Mapping[str, Any]] = None,
    formats: str = "ply",
    keep_states: Union[None, str, int] = None,
    checkpoint_every: int = 10,
    start_from: Optional[PathLike] = None,
    untangle: bool = False,
    segments: int = 1,
    topology: Optional[PathLike] = None,
    overwrite: bool = False,
    progress: Optional[Callable[[int, int], Any]] = None,
) -> Run:
    """Makes a run directory, as ``loomtree run`` does, with the workers as threads of this process.

    Args:
        scene: a scene file, or a dict with its tables, which is written to ``out`` + ``.toml`` first; paths within it are
            relative to that file.
        out: the run directory.
        frames: frames after frame 0; the scene's own number if left out.
        formats: ``ply``, ``obj``, ``pc2``, or several of them with commas between.
        keep_states: ``"frames"`` or a number of steps: states with velocities that stay (``Run.state``).
        checkpoint_every: frames between two checkpoints, which ``resume`` goes on from.
        segments: segments that the shot is split into in time.
        topology: a topology file; its first GPUs are the workers'.
        overwrite: replace a run that is there.
        progress: called as ``progress(frame, frames)`` when a frame is there. If it returns False or raises, the run
            stops after the current step, and ``resume`` can go on.

    The other arguments are those of :class:`Simulation`.

    Raises:
        ValueError: bad input, or a run is there already.
        RuntimeError: the run failed; what it has written stays.
    """
    out = _Path(out)
    options = _options(
        workers=workers,
        resolution=resolution,
        frames=frames,
        executor=executor,
        threads=threads,
        set=_settings(set),
        formats=formats,
        keep_states=None if keep_states is None else str(keep_states),
        checkpoint_every=checkpoint_every,
        start_from=None if start_from is None else _os.fspath(start_from),
        untangle=untangle,
        segments=segments,
        topology=None if topology is None else _os.fspath(topology),
    )
    if isinstance(scene, Mapping):
        path = out.with_name(out.name + ".toml")
        text = scene_text(scene)
        if path.exists() and not overwrite and path.read_text() != text:
            raise ValueError(f"{path} holds another scene; say overwrite=True to replace it")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
        scene = path
    _loomtree.run(_Path(scene), out, options, overwrite, progress)
    return Run(out)


def resume(
    out: PathLike, *, workers: Optional[int] = None, progress: Optional[Callable[[int, int], Any]] = None
) -> Run:
    """Goes on with a run from its newest checkpoint, on any number of workers, with the same bits."""
    _loomtree.resume(_Path(out), workers, progress)
    return Run(out)


def solve(
    matrix: Any,
    rhs: Any = None,
    *,
    workers: int = 1,
    rtol: float = 0.01,
    max_iterations: int = 2000,
    executor: str = "auto",
    threads: Optional[int] = None,
) -> Tuple[_np.ndarray, Dict[str, Any]]:
    """Solves A x = b for a symmetric positive definite matrix by distributed PCG.

    Args:
        matrix: a SciPy sparse matrix or array, (n, n). Blocks of 3 x 3 are what the solver works with; other matrices
            are put into such blocks.
        rhs: (n,) numbers; A times ones if left out.
        rtol: relative residual |b - A x| / |b| to reach, checked in double precision.

    Returns:
        The solution, (n,) float64, and figures: ``iterations``, ``converged``, ``relative_residual``, ``seconds``, ..

    Raises:
        ValueError: a matrix that is not symmetric, or has a diagonal that is not positive.
    """
    import scipy.sparse as sparse

    rows, columns = matrix.shape
    if rows != columns or rows == 0:
        raise ValueError(f"the matrix: expected as many rows as columns, got {rows} x {columns}")
    b = matrix @ _np.ones(rows) if rhs is None else _np.asarray(rhs, dtype=_np.float64)
    if b.shape != (rows,):
        raise ValueError(f"rhs: expected {rows} numbers, got an array of shape {b.shape}")
    padding = -rows % 3
    whole = sparse.block_diag([matrix, sparse.eye(padding)]) if padding else matrix
    whole = sparse.csr_array(whole, dtype=_np.float64)
    whole.sum_duplicates()
    blocks = whole.tobsr((3, 3))
    blocks.sort_indices()
    x, figures = _loomtree.solve(
        blocks.indptr.astype(_np.uint64),
        blocks.indices.astype(_np.uint32),
        _np.ascontiguousarray(blocks.data, dtype=_np.float64),
        _np.concatenate([b, _np.zeros(padding)]),
        rtol,
        max_iterations,
        _options(workers=workers, executor=executor, threads=threads),
    )
    return x[:rows], _json.loads(figures)


def schedule(topology: PathLike, *, kind: str = "auto", bytes: float = 1.8e6) -> Schedule:
    """Plans the transfer stages of a topology file [Li et al. 2020, Sec. 3.1].

    Args:
        topology: a topology file.
        kind: ``"auto"`` (the cheapest), ``"fat-tree"``, ``"ring"``, ``"direct"`` or ``"best"``.
        bytes: size of a sub-vector; 150,000 rows of three float32 if left out.
    """
    return Schedule(*_loomtree.schedule(_Path(topology), kind, float(bytes)))


def scene_text(scene: Mapping[str, Any]) -> str:
    """A scene given as a dict, as the text of a scene file."""
    _refuse_none(scene, "")
    return _loomtree.scene_to_toml(_json.dumps(scene, default=_plain))


def _refuse_none(value: Any, name: str) -> None:
    """TOML has no word for nothing, and its reader would not say where."""
    if value is None:
        raise ValueError(f"the scene: `{name}` is None; leave the field out")
    if isinstance(value, Mapping):
        for key, inner in value.items():
            _refuse_none(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, (list, tuple)):
        for number, inner in enumerate(value):
            _refuse_none(inner, f"{name}.{number}")


def _plain(value: Any) -> Any:
    """NumPy's arrays and numbers as those of Python."""
    if isinstance(value, (_np.ndarray, _np.generic)):
        return value.tolist()
    if isinstance(value, _os.PathLike):
        return _os.fspath(value)
    raise TypeError(f"a scene cannot hold {value!r}")


def _options(**options: Any) -> str:
    """The options that are given, by the names of run.toml."""
    return _json.dumps({name: value for name, value in options.items() if value is not None}, default=_plain)


def _settings(fields: Optional[Mapping[str, Any]]) -> Optional[Sequence[str]]:
    """Fields of a scene as ``--set`` takes them."""
    if not fields:
        return None
    return [f"{name}={_json.dumps(value, default=_plain)}" for name, value in fields.items()]
