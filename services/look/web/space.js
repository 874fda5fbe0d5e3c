// The 3-D view: two point clouds, the posed mesh and the cameras, drawn when something changes. Needs three.js, which is a
// bundle of these exports of three 0.187.0: BufferAttribute BufferGeometry Color DirectionalLight DoubleSide GridHelper Group
// HemisphereLight LineBasicMaterial LineSegments Matrix4 Mesh MeshStandardMaterial PerspectiveCamera Points PointsMaterial
// Scene SRGBColorSpace Vector3 WebGLRenderer, and OrbitControls of three/addons/controls/OrbitControls.js.
"use strict";
const space = { parts: {}, clouds: [] };
const FIELD_DEG = 38; // three.js takes the size of points for a field of 90 degrees
const TINTS = { input: "#2f7fd6", mirror: "#e07b39" };

function bytes(text) { return Uint8Array.from(atob(text), (one) => one.charCodeAt(0)).buffer; }
function styleColor(name) { return new THREE.Color(getComputedStyle(document.documentElement).getPropertyValue(name).trim()); }

function cloudOf(cloud, quantum) {
  const whole = new Int16Array(bytes(cloud.points)), shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(whole, (one) => one * quantum), 3));
  const photo = new Float32Array(whole.length), seen = new Uint8Array(bytes(cloud.colors)), color = new THREE.Color();
  for (let i = 0; i < seen.length; i += 3) {
    color.setRGB(seen[i] / 255, seen[i + 1] / 255, seen[i + 2] / 255, THREE.SRGBColorSpace).toArray(photo, i);
  }
  shape.setAttribute("color", new THREE.BufferAttribute(photo, 3));
  return new THREE.Points(shape, new THREE.PointsMaterial({ size: cloud.size * 1.1 / Math.tan(FIELD_DEG * Math.PI / 360), vertexColors: true }));
}
function bodyOf(body) {
  const shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.BufferAttribute(new Float32Array(bytes(body.vertices)), 3));
  shape.setIndex(new THREE.BufferAttribute(new Uint32Array(bytes(body.faces)), 1));
  shape.computeVertexNormals();
  const look = { color: body.kind === "object" ? "#878f99" : "#4f555e", roughness: 0.9, side: THREE.DoubleSide, flatShading: true };
  return new THREE.Mesh(shape, new THREE.MeshStandardMaterial({ ...look, polygonOffset: true, polygonOffsetFactor: 1, polygonOffsetUnits: 4000 }));
}
function cameraOf(cloud, target) { // a pyramid at the camera's place, and the line along which it looks
  const T = new THREE.Matrix4().set(...cloud.camera), at = (x, y, z) => new THREE.Vector3(x, y, z).applyMatrix4(T).sub(target);
  const w = 0.1, h = 0.075, d = 0.16, tip = at(0, 0, 0);
  const corners = [[-w, -h], [w, -h], [w, h], [-w, h]].map(([x, y]) => at(x, y, d)), ends = [];
  corners.forEach((corner, i) => ends.push(tip, corner, corner, corners[(i + 1) % 4]));
  ends.push(tip, at(0, 0, 0.5));
  const shape = new THREE.BufferGeometry().setFromPoints(ends);
  return new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: TINTS[cloud.role] }));
}

function fill(data) {
  const target = new THREE.Vector3(...data.target), mesh = new THREE.Group(), cameras = new THREE.Group();
  for (const cloud of data.clouds) {
    const points = cloudOf(cloud, data.quantum);
    points.userData.tint = TINTS[cloud.role];
    space.parts[cloud.role] = points;
    space.clouds.push(points);
    cameras.add(cameraOf(cloud, target));
  }
  data.bodies.forEach((body) => mesh.add(bodyOf(body)));
  Object.assign(space.parts, { mesh, cameras });
  const light = new THREE.DirectionalLight("#ffffff", 1.6);
  light.position.set(1, -2, 3);
  space.scene.add(...Object.values(space.parts), new THREE.HemisphereLight("#ffffff", "#777777", 1.6), light);
  const input = new THREE.Vector3(data.clouds[0].camera[3], data.clouds[0].camera[7], 0).sub(new THREE.Vector3(target.x, target.y, 0));
  space.yaw = Math.atan2(input.y, input.x) + 1.2;
}
function reset() {
  const away = 0.95, low = 0.55;
  space.camera.position.set(away * Math.cos(low) * Math.cos(space.yaw), away * Math.cos(low) * Math.sin(space.yaw), away * Math.sin(low));
  space.controls.target.set(0, 0, 0);
  space.controls.update();
  draw();
}
function draw() {
  const canvas = space.renderer.domElement, width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !height) return;
  space.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  space.renderer.setSize(width, height, false);
  space.camera.aspect = width / height;
  space.camera.updateProjectionMatrix();
  space.scene.background = styleColor("--panel");
  space.renderer.render(space.scene, space.camera);
  canvas.dataset.drawn = String(Number(canvas.dataset.drawn || 0) + 1);
}
function setPart(name, on) {
  if (name !== "tint") { space.parts[name].visible = on; return; }
  for (const points of space.clouds) {
    points.material.vertexColors = !on;
    points.material.color.set(on ? points.userData.tint : "#ffffff");
    points.material.needsUpdate = true;
  }
}
function turn(event) {
  const step = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.08], ArrowDown: [0, -0.08] }[event.key];
  const zoom = { "+": 0.9, "=": 0.9, "-": 1 / 0.9 }[event.key];
  if (event.ctrlKey || event.metaKey || event.altKey || !(step || zoom || event.key === "0")) return;
  event.preventDefault();
  if (event.key === "0") { reset(); return; }
  const away = space.camera.position.clone().sub(space.controls.target), far = away.length() * (zoom || 1);
  const yaw = Math.atan2(away.y, away.x) + (step ? step[0] : 0);
  const low = Math.max(-1.5, Math.min(1.5, Math.asin(away.z / away.length()) + (step ? step[1] : 0)));
  away.set(far * Math.cos(low) * Math.cos(yaw), far * Math.cos(low) * Math.sin(yaw), far * Math.sin(low));
  space.camera.position.copy(space.controls.target).add(away);
  space.controls.update();
  draw();
}

function begin(canvas, data) {
  const test = document.createElement("canvas");
  if (!test.getContext("webgl2")) {
    document.getElementById("space-note").textContent = "This browser draws no 3-D here: it has no WebGL 2, or it is switched off.";
    return;
  }
  space.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
  space.scene = new THREE.Scene();
  space.camera = new THREE.PerspectiveCamera(FIELD_DEG, 1, 0.02, 60);
  space.camera.up.set(0, 0, 1);
  space.controls = new THREE.OrbitControls(space.camera, canvas);
  space.controls.enableZoom = false; // the wheel scrolls the page until the view is clicked
  space.controls.addEventListener("change", draw);
  canvas.addEventListener("focus", () => { space.controls.enableZoom = true; });
  canvas.addEventListener("blur", () => { space.controls.enableZoom = false; });
  canvas.addEventListener("pointerdown", () => canvas.focus({ preventScroll: true }));
  canvas.addEventListener("keydown", turn);
  fill(data);
  document.querySelectorAll("[data-part]").forEach((box) => {
    box.addEventListener("change", () => { setPart(box.dataset.part, box.checked); draw(); });
    setPart(box.dataset.part, box.checked);
  });
  document.getElementById("space-reset").addEventListener("click", reset);
  document.addEventListener("verso:theme", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  new ResizeObserver(draw).observe(canvas);
  reset();
}
function connectSpace() { // the view is made when it is about to be seen
  const canvas = document.getElementById("space-canvas"), data = document.getElementById("space-data");
  if (!canvas || !data || space.renderer) return;
  new IntersectionObserver((found, watcher) => {
    if (!found.some((one) => one.isIntersecting)) return;
    watcher.disconnect();
    begin(canvas, JSON.parse(data.textContent));
  }, { rootMargin: "300px" }).observe(canvas);
}
connectSpace();
