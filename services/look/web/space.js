// The 3-D view: the point clouds, the posed mesh and the cameras, drawn when something changes. Needs three.js (r140 or later, global
// `THREE`), which services/look/report.py takes from trimesh's viewer.
"use strict";
const space = { parts: {}, clouds: [], eye: { target: new THREE.Vector3() } };
const FIELD_DEG = 38; // three.js takes the size of points for a field of 90 degrees
THREE.ColorManagement.legacyMode = false; // colours are given in sRGB and lit in linear light
const TINTS = { input: "#2f7fd6", mirror: "#e07b39" };

function bytes(text) { return Uint8Array.from(atob(text), (one) => one.charCodeAt(0)).buffer; }

function cloudOf(cloud, quantum) {
  const whole = new Int16Array(bytes(cloud.points)), shape = new THREE.BufferGeometry();
  shape.setAttribute("position", new THREE.BufferAttribute(Float32Array.from(whole, (one) => one * quantum), 3));
  const photo = new Float32Array(whole.length), seen = new Uint8Array(bytes(cloud.colors)), color = new THREE.Color();
  for (let i = 0; i < seen.length; i += 3) {
    color.fromArray([seen[i] / 255, seen[i + 1] / 255, seen[i + 2] / 255]).convertSRGBToLinear().toArray(photo, i);
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
function cameraOf(pose, target, tint, size) { // a pyramid at the camera's place, and the line along which it looks
  const T = new THREE.Matrix4().set(...pose), at = (x, y, z) => new THREE.Vector3(x, y, z).applyMatrix4(T).sub(target);
  const [w, h, d, line] = [0.1, 0.075, 0.16, 0.5].map((one) => one * size), tip = at(0, 0, 0);
  const corners = [[-w, -h], [w, -h], [w, h], [-w, h]].map(([x, y]) => at(x, y, d)), ends = [];
  corners.forEach((corner, i) => ends.push(tip, corner, corner, corners[(i + 1) % 4]));
  ends.push(tip, at(0, 0, line));
  const shape = new THREE.BufferGeometry().setFromPoints(ends);
  return new THREE.LineSegments(shape, new THREE.LineBasicMaterial({ color: tint }));
}

function fill(data) {
  const target = new THREE.Vector3(...data.target), mesh = new THREE.Group(), cameras = new THREE.Group();
  for (const cloud of data.clouds) {
    const points = cloudOf(cloud, data.quantum);
    points.userData.tint = TINTS[cloud.role];
    space.parts[cloud.role] = points;
    space.clouds.push(points);
    cameras.add(cameraOf(cloud.camera, target, TINTS[cloud.role], 1));
  }
  space.far = data.far;
  data.cameras.forEach((pose) => cameras.add(cameraOf(pose, target, "#8a8f98", 0.5)));
  data.bodies.forEach((body) => mesh.add(bodyOf(body)));
  Object.assign(space.parts, { mesh, cameras });
  const light = new THREE.DirectionalLight("#ffffff", 0.5);
  light.position.set(1, -2, 3);
  space.scene.add(...Object.values(space.parts), new THREE.HemisphereLight("#ffffff", "#777777", 0.5), light);
  const input = new THREE.Vector3(data.clouds[0].camera[3], data.clouds[0].camera[7], 0).sub(new THREE.Vector3(target.x, target.y, 0));
  space.yaw = Math.atan2(input.y, input.x) + 1.2;
}
function choose(number) { // shows another scene, with the same parts of it
  space.scene.clear();
  Object.assign(space, { parts: {}, clouds: [] });
  fill(space.all[number]);
  document.querySelectorAll("[data-part]").forEach((box) => setPart(box.dataset.part, box.checked));
  reset();
}
function reset() {
  Object.assign(space.eye, { yaw: space.yaw, low: 0.55, far: space.far });
  space.eye.target.set(0, 0, 0);
  look();
}
function look() { // puts the camera where yaw, height, distance and target say
  const { yaw, low, far, target } = space.eye;
  space.camera.position.set(Math.cos(low) * Math.cos(yaw), Math.cos(low) * Math.sin(yaw), Math.sin(low)).multiplyScalar(far).add(target);
  space.camera.lookAt(target);
  draw();
}
function orbit(yaw, low, zoom = 1) {
  space.eye.yaw += yaw;
  space.eye.low = Math.max(-1.5, Math.min(1.5, space.eye.low + low));
  space.eye.far = Math.max(0.05, Math.min(40, space.eye.far * zoom));
  look();
}
function pan(right, up) { // metres, in the plane of the picture
  const { target } = space.eye, axis = new THREE.Vector3();
  target.addScaledVector(axis.setFromMatrixColumn(space.camera.matrix, 0), right);
  target.addScaledVector(axis.setFromMatrixColumn(space.camera.matrix, 1), up);
  look();
}
function connectPointer(canvas) { // drag: turn; with Shift, Ctrl or the right button: move; two fingers: zoom and move; wheel: zoom
  const down = new Map(), middle = () => [...down.values()].reduce(([x, y], one) => [x + one[0] / down.size, y + one[1] / down.size], [0, 0]);
  const apart = () => { const [a, b] = [...down.values()]; return b ? Math.hypot(a[0] - b[0], a[1] - b[1]) : 0; };
  canvas.style.touchAction = "none";
  canvas.addEventListener("pointerdown", (event) => {
    canvas.setPointerCapture(event.pointerId);
    down.set(event.pointerId, [event.clientX, event.clientY]);
    canvas.focus({ preventScroll: true });
  });
  canvas.addEventListener("pointermove", (event) => {
    if (!down.has(event.pointerId)) return;
    const before = middle(), wide = apart();
    down.set(event.pointerId, [event.clientX, event.clientY]);
    const [x, y] = middle(), dx = x - before[0], dy = y - before[1];
    const metres = 2 * space.eye.far * Math.tan(FIELD_DEG * Math.PI / 360) / canvas.clientHeight; // of a pixel at the target
    if (down.size > 1) orbit(0, 0, wide / Math.max(apart(), 1));
    if (down.size > 1 || event.shiftKey || event.ctrlKey || event.metaKey || event.buttons & 2) pan(-dx * metres, dy * metres);
    else orbit(-2 * Math.PI * dx / canvas.clientHeight, 2 * Math.PI * dy / canvas.clientHeight);
  });
  for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => down.delete(event.pointerId));
  canvas.addEventListener("contextmenu", (event) => event.preventDefault());
  canvas.addEventListener("wheel", (event) => { // scrolls the page until the view is clicked
    if (document.activeElement !== canvas) return;
    event.preventDefault();
    orbit(0, 0, event.deltaY > 0 ? 1 / 0.95 : 0.95);
  }, { passive: false });
}
function draw() {
  const canvas = space.renderer.domElement, width = canvas.clientWidth, height = canvas.clientHeight;
  if (!width || !height) return;
  space.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
  space.renderer.setSize(width, height, false);
  space.camera.aspect = width / height;
  space.camera.updateProjectionMatrix();
  space.renderer.render(space.scene, space.camera);
  canvas.dataset.drawn = String(Number(canvas.dataset.drawn || 0) + 1);
}
function setPart(name, on) {
  if (name !== "tint") { if (space.parts[name]) space.parts[name].visible = on; return; }
  for (const points of space.clouds.filter((one) => one.userData.tint)) {
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
  orbit(...(step || [0, 0]), zoom);
}

function begin(canvas, data) {
  const test = document.createElement("canvas");
  if (!test.getContext("webgl2")) {
    document.getElementById("space-note").textContent = "This browser draws no 3-D here: it has no WebGL 2, or it is switched off.";
    return;
  }
  space.renderer = new THREE.WebGLRenderer({ canvas, alpha: true, antialias: true, preserveDrawingBuffer: true }); // the page shows through
  space.renderer.outputEncoding = THREE.sRGBEncoding;
  space.scene = new THREE.Scene();
  space.camera = new THREE.PerspectiveCamera(FIELD_DEG, 1, 0.02, 60);
  space.camera.up.set(0, 0, 1);
  connectPointer(canvas);
  canvas.addEventListener("keydown", turn);
  space.all = data;
  document.querySelectorAll("[data-part]").forEach((box) => {
    box.addEventListener("change", () => { setPart(box.dataset.part, box.checked); draw(); });
  });
  const scenes = document.getElementById("space-scene");
  scenes.addEventListener("change", () => {
    document.getElementById("space-missing").textContent = scenes.selectedOptions[0].dataset.missing;
    choose(scenes.value);
  });
  document.getElementById("space-reset").addEventListener("click", reset);
  new ResizeObserver(draw).observe(canvas);
  choose(scenes.value); // which a browser may have kept from before
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
