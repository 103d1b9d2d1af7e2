// What all drawing shares: programs, and the lens as shaders take it.

export const NEAR = 0.005; // world units: nothing closer is drawn
const FAR = 1e5;

// Camera coordinates (x right, y down, z forward) to the clip space of WebGL.
export const LENS = `#version 300 es
precision highp float;
precision highp int;
precision highp usampler2D;
uniform mat4 T_camera_world;
uniform vec4 K; // fx, fy, cx, cy in pixels
uniform vec2 size; // pixels
const float NEAR = ${NEAR}, FAR = ${FAR}.0;
vec3 in_camera(vec3 point) { return (T_camera_world * vec4(point, 1.0)).xyz; }
vec2 pixel(vec3 p) { return K.xy * p.xy / p.z + K.zw; }
vec4 clip(vec2 pixel, float z) {
  vec2 ndc = vec2(2.0, -2.0) * pixel / size + vec2(-1.0, 1.0);
  return vec4(ndc * z, ((FAR + NEAR) * z - 2.0 * FAR * NEAR) / (FAR - NEAR), z);
}
const vec4 NOWHERE = vec4(0.0, 0.0, 2.0, 1.0);
`;

/** A program with its uniforms by name. Raises Error with what the compiler said. */
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  const fragmentText = `#version 300 es\nprecision highp float;\n${fragment}`;
  for (const [kind, text] of [[gl.VERTEX_SHADER, LENS + vertex], [gl.FRAGMENT_SHADER, fragmentText]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, text);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  const count = gl.getProgramParameter(made, gl.ACTIVE_UNIFORMS);
  const names = Array.from({ length: count }, (_, i) => gl.getActiveUniform(made, i).name);
  const uniforms = Object.fromEntries(names.map((name) => [name, gl.getUniformLocation(made, name)]));
  return { made, uniforms, attribute: (name) => gl.getAttribLocation(made, name) };
}

/** Uses the program from where `eye` {T_camera_world, lens, width, height} looks. */
export function use(gl, { made, uniforms }, eye) {
  gl.useProgram(made);
  gl.uniformMatrix4fv(uniforms.T_camera_world, false, eye.T_camera_world);
  gl.uniform4f(uniforms.K, eye.lens.fx, eye.lens.fy, eye.lens.cx, eye.lens.cy);
  gl.uniform2f(uniforms.size, eye.width, eye.height);
}

/** The corners of a square from -1 to 1, as a triangle strip, for attribute `at`. */
export function square(gl, at) {
  gl.bindBuffer(gl.ARRAY_BUFFER, gl.createBuffer());
  gl.bufferData(gl.ARRAY_BUFFER, new Float32Array([-1, -1, 1, -1, -1, 1, 1, 1]), gl.STATIC_DRAW);
  gl.enableVertexAttribArray(at);
  gl.vertexAttribPointer(at, 2, gl.FLOAT, false, 0, 0);
}
