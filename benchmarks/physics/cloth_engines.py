"""Compare our cloth with MuJoCo's own flex on official cloth trials: time, and skill at the label.

    python benchmarks/physics/cloth_engines.py ../shared/official/scenes --every 12

Prints processor seconds a trial and the area under the curve of the smallest distance between
cloth and patient against the recorded outcome. MuJoCo's sheet has edge constraints and the bodies
are their convex pieces, inflated by the distance that cloth keeps in the official simulator.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from physion.numerics.rotations import rotate_vectors
from physion.physics.cloth.simulate import ClothSettings, settle_solids, simulate_cloth
from physion.physics.cloth.solids import particles_of
from physion.physics.replay import area_under_curve
from physion.scenes.scene import Body, Scene
from physion.scenes.shapes.primitives import shape
from physion.scenes.tdw.read_logs import read_scenes

FRAMES = 151


def ours(scene: Scene) -> float:
    """Smallest distance in metres, from `simulate_cloth`."""
    positions = np.tile([body.position for body in scene.bodies], (FRAMES, 1, 1))
    rotations = np.tile([body.rotation for body in scene.bodies], (FRAMES, 1, 1))
    return float(np.nanmin(simulate_cloth(scene, positions, rotations).distance))


def mujoco_flex(scene: Scene, resolution: int) -> float:
    """The same from a MuJoCo flex of ``resolution`` vertices a side."""
    settings = ClothSettings()
    model = mujoco.MjModel.from_xml_string(_model_xml(scene, resolution, settings))
    data = mujoco.MjData(model)
    patient = scene.bodies[scene.index(scene.roles.patient)]
    particles = rotate_vectors(patient.rotation, particles_of(patient, settings.particle_spacing))
    tree = cKDTree(particles + patient.position)
    smallest = np.inf
    steps = round(0.01 / model.opt.timestep)
    for _ in range(FRAMES - 1):
        mujoco.mj_step(model, data, steps)
        smallest = min(smallest, tree.query(data.flexvert_xpos)[0].min())
    return float(smallest - settings.rest_distance)


def _model_xml(scene: Scene, resolution: int, settings: ClothSettings) -> str:
    cloth = scene.cloths[0]
    spacing = [side / (resolution - 1) for side in cloth.size[:2]]
    # Solid particles lie up to half a spacing inside the surface.
    inflation = settings.rest_distance - settings.particle_spacing / 2
    assets, geoms = [], []
    for body in scene.bodies:
        for number, piece in enumerate(shape(body.shape).pieces):
            name = f"{body.name}_{number}"
            assets.append(_mesh_xml(name, piece.mesh.vertices, body))
            geoms.append(
                f'<geom type="mesh" mesh={quoteattr(name)} pos="{_text(body.position)}" '
                f'quat="{_text(body.rotation)}" margin="{inflation}"/>'
            )
    return f"""<mujoco>
  <option timestep="0.0025" integrator="implicitfast" solver="CG" iterations="50"/>
  <size memory="400M"/>
  <asset>{"".join(assets)}</asset>
  <worldbody>
    <geom type="plane" size="5 5 1"/>
    {"".join(geoms)}
    <flexcomp name="cloth" type="grid" dim="2" count="{resolution} {resolution} 1"
      spacing="{spacing[0]} {spacing[1]} 1" pos="{_text(cloth.position)}" mass="{cloth.mass}"
      radius="0.01"><edge equality="true" damping="0.01"/>
      <contact selfcollide="none" condim="3" friction="1"/></flexcomp>
  </worldbody></mujoco>"""


def _mesh_xml(name: str, vertices: np.ndarray, body: Body) -> str:
    corners = _text(np.ravel(vertices * np.asarray(body.scale)))
    return f'<mesh name={quoteattr(name)} vertex="{corners}" refpos="0 0 0"/>'


def _text(values: object) -> str:
    return " ".join(f"{value:.9g}" for value in np.asarray(values, float))


def main() -> None:
    """Run both on every n-th official trial and print a line each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scenes", type=Path)
    parser.add_argument("--every", type=int, default=12, help="take every n-th trial")
    parser.add_argument("--flex", type=int, default=19, help="vertices a side of MuJoCo's flex")
    options = parser.parse_args()
    trials = read_scenes(options.scenes, "drape").unique()[0][:: options.every]
    scenes = [settle_solids(trial.scene) for trial in trials]
    contacts = np.array([trial.outcome.contact for trial in trials])
    ours(scenes[0])  # compiles
    for name, run in (
        ("ours", ours),
        (f"mujoco flex {options.flex}x{options.flex}", lambda s: mujoco_flex(s, options.flex)),
    ):
        started = time.process_time()
        distances = np.array([run(scene) for scene in scenes])
        spent = (time.process_time() - started) / len(scenes)
        skill = area_under_curve(-distances, contacts)
        print(f"{name}: {len(scenes)} trials, {spent:.2f} s a trial, AUC {skill:.3f}")


if __name__ == "__main__":
    main()
