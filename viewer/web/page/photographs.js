// The photographs on their cameras' frusta. Each is fetched once, and few at a time.

import { program, square, use } from "/gl.js";

const VERTEX = `
in vec2 corner;
uniform vec3 corners[4]; // top left, top right, bottom right, bottom left
out vec2 at;
void main() {
  at = 0.5 * corner + 0.5; // 0, 0 is the image's first pixel, which is its top left one
  vec3 top = mix(corners[0], corners[1], at.x), bottom = mix(corners[3], corners[2], at.x);
  vec3 p = in_camera(mix(top, bottom, at.y));
  gl_Position = p.z < NEAR ? NOWHERE : clip(pixel(p), p.z);
}`;

const FRAGMENT = `
in vec2 at;
uniform sampler2D image;
out vec4 shown;
void main() { shown = vec4(texture(image, at).rgb, 1.0); }`;

const MOST = 120; // that are kept

export class Photographs {
  constructor(gl, changed) {
    this.gl = gl;
    this.changed = changed;
    this.textures = new Map(); // by the album and the camera's name
    this.fetching = false;
    this.program = program(gl, VERTEX, FRAGMENT);
    this.array = gl.createVertexArray();
    gl.bindVertexArray(this.array);
    square(gl, this.program.attribute("corner"));
    gl.bindVertexArray(null);
  }

  /** Fetches those of `cameras` (version `version` of the shapes; `album`: whose names they have) that are not there yet. */
  async fetch(album, cameras, version) {
    const wanted = cameras.map(({ name, photograph }, index) => ({ key: `${album}\n${name}`, index, photograph }));
    const keys = new Set(wanted.map(({ key }) => key));
    for (const [key, texture] of this.textures) {
      if (keys.has(key)) continue;
      this.gl.deleteTexture(texture);
      this.textures.delete(key);
    }
    const job = (this.fetching = {}); // a later call ends this one
    for (const { key, index } of wanted.filter(({ photograph }) => photograph).slice(0, MOST)) {
      if (this.textures.has(key)) continue;
      const answer = await fetch(`/thumbnail/${version}/${index}`).catch(() => null);
      if (this.fetching !== job || !answer?.ok) return;
      const image = await createImageBitmap(await answer.blob()).catch(() => null);
      if (this.fetching !== job) return;
      if (image) this.textures.set(key, this.#texture(image));
      this.changed();
    }
  }

  draw(eye, album, cameras) {
    const { gl } = this;
    use(gl, this.program, eye);
    gl.enable(gl.DEPTH_TEST);
    gl.disable(gl.BLEND);
    gl.bindVertexArray(this.array);
    for (const camera of cameras) {
      const texture = this.textures.get(`${album}\n${camera.name}`);
      if (!texture) continue;
      gl.bindTexture(gl.TEXTURE_2D, texture);
      gl.uniform3fv(this.program.uniforms["corners[0]"], camera.corners.flat());
      gl.drawArrays(gl.TRIANGLE_STRIP, 0, 4);
    }
    gl.bindVertexArray(null);
  }

  #texture(image) {
    const { gl } = this;
    const texture = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, texture);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, gl.RGBA, gl.UNSIGNED_BYTE, image);
    gl.generateMipmap(gl.TEXTURE_2D);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR_MIPMAP_LINEAR);
    for (const name of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, name, gl.CLAMP_TO_EDGE);
    return texture;
  }
}
