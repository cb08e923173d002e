"""How long a frame takes: ``python benchmarks/trials/rendering.py [--write]``.

The reference scene has about 12,000 triangles in the box room: a still zone, fourteen bodies that
fly and turn, and a 40 x 40 cloth that waves, all of which move in every frame. Times are process
CPU time on one core; each measured frame is another instant. ``start`` is a whole process from
nothing to its first frame with all passes, without and with numba's machine code on disk (Python's
own bytecode is there in both).
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from physion.physics.trajectory import Contacts, Trajectory
from physion.rendering.renderer import PASSES, Renderer, RenderSettings
from physion.scenes.scene import Body, Camera, Cloth, Look, Roles, Scene

RESULTS = Path(__file__).parents[1] / "results"
SHAPES = (
    *("sphere", "bowl", "sphere", "torus", "pipe", "sphere", "cone"),
    *("sphere", "cylinder", "sphere", "cube", "sphere", "dumbbell", "sphere"),
)
FRAMES = 24


def reference_scene() -> tuple[Scene, Trajectory]:
    """The scene that the issue's figure is about, and its motion."""
    rng = np.random.default_rng(1)
    places = rng.uniform((-1.1, -1.1, 0.05), (1.1, 1.1, 0.7), (len(SHAPES), 3))
    colors = rng.uniform(0.1, 1.0, (len(SHAPES), 3))
    zone_look, cloth_look = Look((0.9, 0.85, 0.2), "wood_ash"), Look((0.1, 0.45, 0.75), "cloth")
    zone = Body("zone", "cube", (0.5, 0.0, 0.0), (1.6, 1.6, 0.01), kinematic=True, look=zone_look)
    bodies = [
        Body(
            f"{shape}_{i}",
            shape,
            (float(at[0]), float(at[1]), float(at[2])),
            (0.35, 0.35, 0.35),
            look=Look((float(color[0]), float(color[1]), float(color[2])), "wood_cedar"),
        )
        for i, (shape, at, color) in enumerate(zip(SHAPES, places, colors, strict=True))
    ]
    cloth = Cloth("cloth", (0.0, 0.0, 1.0), (1.4, 1.4, 0.0), resolution=40, look=cloth_look)
    scene = Scene(
        name="reference",
        scenario="benchmark",
        bodies=(zone, *bodies),
        roles=Roles("cloth", "zone"),
        camera=Camera((2.1, 2.0, 1.4), (0.0, 0.0, 0.5)),
        cloths=(cloth,),
    )
    return scene, _motion(scene, rng)


def _motion(scene: Scene, rng: np.random.Generator) -> Trajectory:
    frames, count = FRAMES + 1, len(scene.bodies)
    step = np.arange(frames)[:, None, None]
    velocity = rng.uniform(-0.01, 0.01, (count, 3))
    velocity[0] = 0.0
    positions = np.array([body.position for body in scene.bodies]) + step * velocity
    axis = rng.standard_normal((count, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    half = 0.04 * step * (np.arange(count) > 0)[:, None]
    rotations = np.concatenate([np.cos(half), np.sin(half) * axis], axis=-1)
    cloth = scene.cloths[0]
    x, y = np.meshgrid(*2 * [np.linspace(-0.7, 0.7, cloth.resolution)], indexing="ij")
    z = 0.9 + 0.15 * np.sin(4 * x + 3 * y + 0.2 * step) - 0.25 * (x**2 + y**2)
    sheet = np.stack([np.broadcast_to(x, z.shape), np.broadcast_to(y, z.shape), z], axis=-1)
    still = np.zeros(positions.shape, np.float32)
    return Trajectory(
        positions=positions.astype(np.float32),
        rotations=rotations.astype(np.float32),
        velocities=still,
        angular_velocities=still,
        cloth_vertices=sheet.reshape(frames, -1, 3).astype(np.float32),
        cloth_distance=np.full(frames, np.nan, np.float32),
        contacts=Contacts.empty(),
        completed=True,
        engine="by hand",
    )


def milliseconds(size: int, passes: tuple[str, ...], still_layer: bool = True) -> dict[str, float]:
    """CPU milliseconds a frame: of the first (with set-up), and mean and worst of the others."""
    scene, trajectory = reference_scene()
    start = time.process_time()
    renderer = Renderer(scene, trajectory, size, size, RenderSettings(keep_static=still_layer))
    renderer.render(0, passes)
    first = time.process_time() - start
    times = []
    for frame in range(1, FRAMES):
        start = time.process_time()
        renderer.render(frame, passes)
        times.append(time.process_time() - start)
    result = {"mean": np.mean(times), "worst": np.max(times), "first_with_set_up": first}
    return {name: round(1000 * float(value), 1) for name, value in result.items()}


def start_seconds() -> dict[str, dict[str, float]]:
    """Seconds of a whole process with one frame, without and with compiled code on disk.

    The least of three, since other work on the machine only adds to them.
    """
    code = "import benchmark_rendering as b; b.first_frame()"
    result: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        Path(folder, "benchmark_rendering.py").write_text(Path(__file__).read_text())
        environment = {**os.environ, "PYTHONPATH": folder, "OMP_NUM_THREADS": "1"}
        environment["PYTHONPYCACHEPREFIX"] = str(Path(folder, "bytecode"))
        environment.pop("PYTHONDONTWRITEBYTECODE", None)
        runs = [("warm up", 0)] + [(name, i) for i in range(1, 4) for name in ("cold", "cached")]
        for name, cache in runs:
            environment["NUMBA_CACHE_DIR"] = str(Path(folder, str(cache)))
            before, wall = os.times(), time.perf_counter()
            subprocess.run([sys.executable, "-c", code], env=environment, check=True)
            after = os.times()
            cpu = after.children_user + after.children_system
            cpu -= before.children_user + before.children_system
            best = result.setdefault(name, {"cpu": np.inf, "wall": np.inf})
            best["cpu"] = min(best["cpu"], round(cpu, 2))
            best["wall"] = min(best["wall"], round(time.perf_counter() - wall, 2))
    del result["warm up"]
    return result


def loop_seconds() -> float:
    """CPU seconds that Python takes to add up ten million numbers: how busy the machine is."""
    start, total = time.process_time(), 0
    for i in range(10_000_000):
        total += i
    return round(time.process_time() - start, 2)


def first_frame() -> None:
    """What a new process does in the measurement of its start."""
    scene, trajectory = reference_scene()
    Renderer(scene, trajectory).render(0, PASSES)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--write", action="store_true", help="keep the result in results/")
    arguments = parser.parse_args()
    renderer = Renderer(*reference_scene(), 32, 32)
    for passes in (PASSES, ("color",)):
        renderer.render(0, passes)  # compile
    result = {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "hardware": "AMD EPYC, 2 cores",
        "python": platform.python_version(),
        "command": "python benchmarks/trials/rendering.py --write",
        "triangles": renderer.triangles,
        "load_average": round(os.getloadavg()[0], 1),
        "cpu_s_of_10_million_additions": loop_seconds(),
        "cpu_ms_a_frame": {
            "256 all five passes": milliseconds(256, PASSES),
            "256 color": milliseconds(256, ("color",)),
            "256 ids": milliseconds(256, ("ids",)),
            "256 all five passes, nothing kept between frames": milliseconds(256, PASSES, False),
            "512 all five passes": milliseconds(512, PASSES),
            "512 color": milliseconds(512, ("color",)),
        },
        "start_s": start_seconds(),
    }
    text = json.dumps(result, indent=2)
    print(text)
    if arguments.write:
        RESULTS.mkdir(exist_ok=True)
        (RESULTS / "rendering.json").write_text(text + "\n")


if __name__ == "__main__":
    main()
