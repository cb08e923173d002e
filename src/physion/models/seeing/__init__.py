"""Models that see: from masks and depth of the observed frames to bodies, then simulation.

`pixels` turns a frame into rays, `solids` compares rays with a placed shape and moves it to where
it fits, `bodies` finds shape and pose of one object and follows it, `scenes` puts the objects
together to a scene with velocities, and `simulation` is the model.
"""
