// Poses of bodies and vertices of cloths at each frame.
class Motion {
  constructor(data, shapes) {
    this.data = data;
    this.start = decodeArray(data.start.positions, Float32Array);
    this.startRotations = decodeArray(data.start.rotations, Int16Array);
    this.positions = decodeArray(data.positions, Float32Array);
    this.rotations = decodeArray(data.rotations, Int16Array);
    this.movingIndex = new Map(data.moving.map((body, k) => [body, k]));
    this.cloths = data.cloths.map((cloth) => ({ ...cloth, points: decodePoints(cloth.points) }));
    this.boxCentres = data.bodies.map((body) => {
      const { low, size } = shapes[body.shape].points;
      return low.map((v, i) => (v + size[i] / 2) * body.scale[i]);
    });
  }

  // Return position and rotation (quaternion) of a body.
  pose(body, frame) {
    const k = this.movingIndex.get(body);
    const moves = k !== undefined;
    const row = moves ? frame * this.data.moving.length + k : body;
    const positions = moves ? this.positions : this.start;
    const rotations = moves ? this.rotations : this.startRotations;
    const rotation = unit([...rotations.subarray(4 * row, 4 * row + 4)]);
    return { position: [...positions.subarray(3 * row, 3 * row + 3)], rotation };
  }

  // Return the centre of a body's bounding box.
  boxCentre(body, frame) {
    const { position, rotation } = this.pose(body, frame);
    return add(position, rotate(rotation, this.boxCentres[body]));
  }

  // Return the vertices of a cloth, interpolated linearly between the stored instants.
  clothVertices(cloth, frame) {
    return interpolate(cloth.points, cloth.instants, frame);
  }

  // Return the path of the object with a role, one point per frame; null if it does not move.
  path(role) {
    const out = new Float32Array(3 * this.data.frames);
    const body = this.data.bodies.findIndex((b) => b.role === role);
    const cloth = this.cloths.find((c) => c.role === role);
    if (!this.movingIndex.has(body) && !cloth) return null;
    for (let frame = 0; frame < this.data.frames; frame++) {
      out.set(cloth ? this.meanPoint(this.clothVertices(cloth, frame)) : this.boxCentre(body, frame), 3 * frame);
    }
    return out;
  }

  meanPoint(points) {
    const sum = [0, 0, 0];
    for (let i = 0; i < points.length; i++) sum[i % 3] += points[i];
    return times(sum, 3 / points.length);
  }
}

// Return points at a frame, linearly from those stored at some frames: between them and before the
// first one, and the last ones afterwards.
function interpolate(points, frames, frame) {
  let k = 0;
  while (k < frames.length - 2 && frames[k + 1] <= frame) k++;
  const next = Math.min(k + 1, frames.length - 1);
  const span = frames[next] - frames[k];
  const weight = span > 0 ? Math.min((frame - frames[k]) / span, 1) : 0;
  const size = points.length / frames.length;
  const out = new Float32Array(size);
  for (let i = 0; i < size; i++) {
    out[i] = (1 - weight) * points[k * size + i] + weight * points[next * size + i];
  }
  return out;
}

// Return the triangles of a square grid of vertices.
function clothFaces(side) {
  const faces = [];
  for (let i = 0; i < side - 1; i++) {
    for (let j = 0; j < side - 1; j++) {
      const a = i * side + j;
      faces.push(a, a + side, a + side + 1, a, a + side + 1, a + 1);
    }
  }
  return new Uint16Array(faces);
}

// Return vertex normals, weighted by the area of the faces and not normalised.
function clothNormals(points, faces) {
  const out = new Float32Array(points.length);
  const at = (i) => [points[3 * i], points[3 * i + 1], points[3 * i + 2]];
  for (let t = 0; t < faces.length; t += 3) {
    const [a, b, c] = [0, 1, 2].map((k) => at(faces[t + k]));
    const normal = cross(subtract(b, a), subtract(c, a));
    for (let k = 0; k < 3; k++) for (let i = 0; i < 3; i++) out[3 * faces[t + k] + i] += normal[i];
  }
  return out;
}

// Grid of 1 m lines on the floor, in segments of 1 m: software drivers drop long lines that pass
// behind the camera.
function floorLines(height) {
  const points = [];
  for (let i = -6; i <= 6; i++) {
    for (let j = -6; j < 6; j++) points.push(i, j, height, i, j + 1, height, j, i, height, j + 1, i, height);
  }
  return new Float32Array(points);
}
