// Particles that a model imagined, at each frame after the observed part.

const PARTICLE_COLORS = { agent: [0.88, 0.08, 0.08], patient: [0.93, 0.72, 0] };

class ImaginedParticles {
  constructor(gl, { from, frames, points, groups }) {
    this.from = from;
    this.frames = frames;
    this.groups = groups;
    this.points = decodePoints(points);
    this.buffers = new Buffers(gl, this.at(from), null, null, gl.DYNAMIC_DRAW);
  }

  at(frame) {
    return interpolate(this.points, this.frames, frame);
  }

  // Call `paint` with the buffers, colour, first point and number of points of each object.
  paint(frame, dark, paint) {
    this.buffers.update(this.at(frame), null);
    for (const { role, first, count } of this.groups) {
      const grey = dark ? [0.78, 0.8, 0.84] : [0.3, 0.32, 0.36];
      paint(this.buffers, PARTICLE_COLORS[role] ?? grey, first, count);
    }
  }
}
