// A mesh of the scene (splatvk mesh SCENE FILE.glb) over the splats: wireframe, solid, or none.
import { rotate, sub, unrotate } from "splatvk/camera";
import { canvas, find, manifest, say, scene } from "splatvk/page";
import { program } from "splatvk/render";
import { changed, overlay } from "splatvk/stage";

/// Kinds of picture, in the order of the button.
const KINDS = ["", "wireframe", "solid"];
let kind = "", mesh = null;

const VERTEX = `#version 300 es
precision highp float;
layout(location = 0) in vec3 place;
layout(location = 1) in vec3 colour;
uniform mat3 rotation;
uniform vec3 translation;
uniform vec4 intrinsics;
uniform vec2 size;
uniform float near, far;
out vec3 seen, paint;
void main() {
  seen = rotation * place + translation;
  paint = colour;
  vec2 pixel = intrinsics.xy * seen.xy + intrinsics.zw * seen.z;
  gl_Position = vec4(2.0 * pixel / size - seen.z, (far * (seen.z - near) * 2.0) / (far - near) - seen.z, seen.z) * vec4(1, -1, 1, 1);
}`;

// Light from the camera shows the shape; the normal is that of the triangle.
const FRAGMENT = `#version 300 es
precision highp float;
in vec3 seen, paint;
uniform int wires;
out vec4 shown;
void main() {
  if (wires == 1) { shown = vec4(0.48, 0.78, 1.0, 0.8); return; }
  vec3 normal = normalize(cross(dFdx(seen), dFdy(seen)));
  shown = vec4(paint * (0.35 + 0.65 * abs(dot(normal, normalize(seen)))), 1.0);
}`;

/// Adds the button and the key, where the server has a mesh.
export function connectMesh() {
  if (!manifest.mesh) return;
  find("[data-do=mesh]").hidden = false;
  overlay(draw);
}

/// Shows the next kind of picture of the mesh.
export async function nextMesh() {
  if (!manifest.mesh) return;
  if (!mesh) {
    say("Loading the mesh …", true);
    try {
      mesh = read(await (await fetch("mesh.glb")).arrayBuffer());
    } catch (error) {
      return say(`The mesh cannot be shown: ${error.message}`);
    }
  }
  kind = KINDS[(KINDS.indexOf(kind) + 1) % KINDS.length];
  find("[data-do=mesh]").setAttribute("aria-pressed", String(kind !== ""));
  const count = (mesh.triangles.length / 3).toLocaleString("en");
  const place = mesh.placed ? "" : " It states no place: it is drawn in the axes of the scene.";
  say(kind ? `Mesh: ${kind}, ${count} triangles.${place}` : "");
  changed();
}

/// Numbers of an accessor as floats; normalised where they are whole.
function numbers(json, buffer, index) {
  const accessor = json.accessors[index], view = json.bufferViews[accessor.bufferView];
  const width = { SCALAR: 1, VEC3: 3, VEC4: 4 }[accessor.type];
  const [Kind, most] = { 5121: [Uint8Array, 255], 5123: [Uint16Array, 65535], 5125: [Uint32Array, 1], 5126: [Float32Array, 1] }[accessor.componentType];
  const step = view.byteStride ?? width * Kind.BYTES_PER_ELEMENT, start = (view.byteOffset ?? 0) + (accessor.byteOffset ?? 0);
  const out = accessor.type === "SCALAR" ? new Uint32Array(accessor.count) : new Float32Array(3 * accessor.count);
  for (let i = 0; i < accessor.count; i++) {
    const from = new Kind(buffer.slice(start + i * step, start + i * step + width * Kind.BYTES_PER_ELEMENT));
    if (width === 1) out[i] = from[0];
    else for (let k = 0; k < 3; k++) out[3 * i + k] = accessor.normalized ? from[k] / most : from[k];
  }
  return out;
}

/// Reads a GLB file into positions in the scene, colours (sRGB) and triangles.
function read(file) {
  const head = new DataView(file);
  if (file.byteLength < 28 || head.getUint32(0, true) !== 0x46546c67) throw new Error("it is no .glb file");
  const length = head.getUint32(12, true), json = JSON.parse(new TextDecoder().decode(new Uint8Array(file, 20, length)));
  const buffer = file.slice(28 + length);
  const from = json.nodes.map((node) => node.extras?.from_scene).find(Boolean);
  const place = from ? (p) => unrotate(from.rotation, sub(p, from.translation).map((v) => v / from.scale)) : ([x, y, z]) => [x, -y, -z];
  const positions = [], colours = [], triangles = [];
  for (const node of json.nodes.filter((n) => n.mesh !== undefined && !n.extras?.collider)) {
    for (const { attributes, indices } of json.meshes[node.mesh].primitives) {
      const first = positions.length / 3, own = numbers(json, buffer, attributes.POSITION);
      const paint = attributes.COLOR_0 === undefined ? null : numbers(json, buffer, attributes.COLOR_0);
      const moved = node.translation ?? [0, 0, 0];
      for (let i = 0; i < own.length; i += 3) {
        positions.push(...place([0, 1, 2].map((k) => own[i + k] + moved[k])));
        for (let k = 0; k < 3; k++) colours.push(paint ? srgb(paint[i + k]) : 0.8);
      }
      for (const index of numbers(json, buffer, indices)) triangles.push(first + index);
    }
  }
  if (!triangles.length) throw new Error("it has no triangles");
  return { positions: new Float32Array(positions), colours: new Float32Array(colours), triangles: new Uint32Array(triangles), placed: Boolean(from) };
}

const srgb = (v) => (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);

/// Edges of triangles, each once.
function edgesOf(triangles) {
  const known = new Set(), out = [];
  for (let i = 0; i < triangles.length; i++) {
    const [a, b] = [triangles[i], triangles[i % 3 === 2 ? i - 2 : i + 1]], key = Math.min(a, b) * 2 ** 26 + Math.max(a, b);
    if (known.has(key)) continue;
    known.add(key);
    out.push(a, b);
  }
  return new Uint32Array(out);
}

/// Buffers of the mesh in a graphics context.
function upload(gl) {
  const buffer = (target, data) => {
    const made = gl.createBuffer();
    gl.bindBuffer(target, made);
    gl.bufferData(target, data, gl.STATIC_DRAW);
    return made;
  };
  const array = gl.createVertexArray();
  gl.bindVertexArray(array);
  [mesh.positions, mesh.colours].forEach((data, at) => {
    buffer(gl.ARRAY_BUFFER, data);
    gl.enableVertexAttribArray(at);
    gl.vertexAttribPointer(at, 3, gl.FLOAT, false, 0, 0);
  });
  const faces = buffer(gl.ELEMENT_ARRAY_BUFFER, mesh.triangles), lines = edgesOf(mesh.triangles);
  return { gl, array, faces, lines: buffer(gl.ELEMENT_ARRAY_BUFFER, lines), edges: lines.length, ...program(gl, VERTEX, FRAGMENT) };
}

/// Draws the mesh over the picture; parts of it hide others, splats do not.
function draw(camera) {
  if (!kind) return;
  const { gl } = scene.renderer;
  if (mesh.drawn?.gl !== gl || !gl.isProgram(mesh.drawn.made)) mesh.drawn = upload(gl);
  const { made, at, array, faces, lines, edges } = mesh.drawn, [width, height] = [canvas.width, canvas.height];
  gl.useProgram(made);
  gl.uniformMatrix3fv(at.rotation, true, camera.rotation);
  gl.uniform3fv(at.translation, rotate(camera.rotation, camera.position).map((v) => -v));
  gl.uniform4fv(at.intrinsics, camera.intrinsics(width, height));
  gl.uniform2f(at.size, width, height);
  gl.uniform1f(at.near, scene.near);
  gl.uniform1f(at.far, 1e4 * scene.near);
  gl.uniform1i(at.wires, 0);
  gl.bindFramebuffer(gl.FRAMEBUFFER, null);
  gl.viewport(0, 0, width, height);
  gl.bindVertexArray(array);
  gl.enable(gl.DEPTH_TEST);
  gl.depthFunc(gl.LEQUAL);
  gl.clear(gl.DEPTH_BUFFER_BIT);
  gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, faces);
  const wires = kind === "wireframe";
  gl.colorMask(!wires, !wires, !wires, false);
  // Lines in the plane of a triangle stay in front of it.
  gl.enable(gl.POLYGON_OFFSET_FILL);
  gl.polygonOffset(1, 1);
  gl.drawElements(gl.TRIANGLES, mesh.triangles.length, gl.UNSIGNED_INT, 0);
  gl.disable(gl.POLYGON_OFFSET_FILL);
  gl.colorMask(true, true, true, true);
  if (wires) {
    gl.uniform1i(at.wires, 1);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, lines);
    gl.enable(gl.BLEND);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
    gl.drawElements(gl.LINES, edges, gl.UNSIGNED_INT, 0);
    gl.disable(gl.BLEND);
  }
  gl.disable(gl.DEPTH_TEST);
  gl.bindVertexArray(null);
}
