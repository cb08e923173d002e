// WebGL 2 helpers of the 3D view: two shader programs and vertex buffers.

const MESH_SHADERS = [`#version 300 es
  in vec3 point, normal;
  uniform mat4 view; uniform vec3 scale, translation; uniform vec4 rotation;
  out vec3 world_normal, world_position;
  vec3 rotate(vec3 v) {
    return v + 2.0 * cross(rotation.yzw, cross(rotation.yzw, v) + rotation.x * v);
  }
  void main() {
    world_position = rotate(point * scale) + translation;
    world_normal = rotate(normal / scale);
    gl_Position = view * vec4(world_position, 1.0);
  }`, `#version 300 es
  precision highp float;
  in vec3 world_normal, world_position; uniform vec3 color, eye; out vec4 pixel;
  void main() {
    vec3 n = normalize(world_normal), to_eye = normalize(eye - world_position);
    if (dot(n, to_eye) < 0.0) n = -n;
    float directional = max(dot(n, normalize(vec3(0.35, -0.5, 0.8))), 0.0);
    float sky = 0.5 + 0.5 * n.z, facing = max(dot(n, to_eye), 0.0);
    pixel = vec4(color * (0.28 + 0.24 * sky + 0.4 * directional + 0.16 * facing), 1.0);
  }`];

const LINE_SHADERS = [`#version 300 es
  in vec3 point; uniform mat4 view; uniform float size;
  void main() { gl_Position = view * vec4(point, 1.0); gl_PointSize = size; }`, `#version 300 es
  precision highp float;
  uniform vec4 color; out vec4 pixel; void main() { pixel = color; }`];

/**
 * Compile a program; `uniforms` are the locations of its uniforms, by name.
 * @param {WebGL2RenderingContext} gl
 * @param {string[]} sources Vertex and fragment shader.
 */
function compile(gl, [vertex, fragment]) {
  const program = gl.createProgram();
  /** @type {[number, string][]} */
  const shaders = [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]];
  for (const [kind, source] of shaders) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, source);
    gl.compileShader(shader);
    gl.attachShader(program, shader);
  }
  gl.bindAttribLocation(program, 0, "point");
  gl.bindAttribLocation(program, 1, "normal");
  gl.linkProgram(program);
  const uniforms = {};
  const count = gl.getProgramParameter(program, gl.ACTIVE_UNIFORMS);
  for (let i = 0; i < count; i++) {
    const { name } = gl.getActiveUniform(program, i);
    uniforms[name] = gl.getUniformLocation(program, name);
  }
  return { program, uniforms };
}

// Vertex buffers of a mesh; `normals` and `faces` are null for points and lines.
class Buffers {
  constructor(gl, points, normals, faces, usage = gl.STATIC_DRAW) {
    this.gl = gl;
    this.vertexArray = gl.createVertexArray();
    gl.bindVertexArray(this.vertexArray);
    this.points = this.createBuffer(0, points, gl.FLOAT, usage);
    if (normals) {
      const kind = normals instanceof Int8Array ? gl.BYTE : gl.FLOAT;
      this.normals = this.createBuffer(1, normals, kind, usage);
    }
    if (faces) {
      gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, gl.createBuffer());
      gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, faces, gl.STATIC_DRAW);
    }
    this.count = faces ? faces.length : points.length / 3;
  }

  createBuffer(location, values, kind, usage) {
    const { gl } = this;
    const buffer = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
    gl.bufferData(gl.ARRAY_BUFFER, values, usage);
    gl.enableVertexAttribArray(location);
    gl.vertexAttribPointer(location, 3, kind, kind === gl.BYTE, 0, 0);
    return buffer;
  }

  update(points, normals) {
    const { gl } = this;
    for (const [buffer, values] of [[this.points, points], [this.normals, normals]]) {
      if (!buffer) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferSubData(gl.ARRAY_BUFFER, 0, values);
    }
  }
}
