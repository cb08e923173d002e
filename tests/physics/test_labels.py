"""Labels of hand-made trajectories."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from physion.physics.labels import contact_frames, label_contact
from physion.scenes.scene import BodyEvent
from support.hand_made import make_scene, make_trajectory


def test_absent_bodies_cannot_touch() -> None:
    scene = make_scene(cloth=False)
    path = make_trajectory(scene, contact_frame=50)
    assert contact_frames(scene, path).tolist() == list(range(50, 60))
    late = replace(scene, events=(BodyEvent(53, "ball", "appear"), BodyEvent(55, "box", "vanish")))
    assert contact_frames(late, path).tolist() == [53, 54]
    assert label_contact(late, path).first_frame == 53
    never = replace(scene, events=(BodyEvent(20, "ball", "vanish"),))
    assert not label_contact(never, path).contact


def test_a_cloth_touches_only_a_body_that_is_there() -> None:
    scene = make_scene()
    scene = replace(scene, roles=replace(scene.roles, agent="sheet"))
    path = make_trajectory(scene, contact_frame=None)
    path = replace(path, cloth_distance=np.full(len(path), -1.0, np.float32))
    late = replace(scene, events=(BodyEvent(7, "box", "appear"),))
    assert label_contact(scene, path).first_frame == 0
    assert label_contact(late, path).first_frame == 7
