"use strict";
/* The model: looks, clips, bones, the clip's own camera. Reads #model-data; `BanmoViewer.start(data)` returns its handle. */
const BanmoViewer = (() => {
  const LOOKS = { colour: "Colour", skin: "Bones' skin", seen: "What was seen", normals: "Shape" };
  const hue = (j) => { const c = new THREE.Color(); c.setHSL((j * 0.61803) % 1, j % 2 ? 0.72 : 0.55, j % 2 ? 0.58 : 0.5); return c; };
  const RAMP = [[0.27, 0.0, 0.33], [0.23, 0.32, 0.55], [0.13, 0.57, 0.55], [0.37, 0.79, 0.38], [0.99, 0.91, 0.14]];
  function ramp(t) {
    const x = Math.max(0, Math.min(0.9999, t)) * (RAMP.length - 1), i = Math.floor(x), f = x - i;
    return RAMP[i].map((v, k) => v + (RAMP[i + 1][k] - v) * f);
  }
  const linear = (c) => (c <= 0.04045 ? c / 12.92 : Math.pow((c + 0.055) / 1.055, 2.4));

  function bytesOf(uri) {
    const text = atob(uri.slice(uri.indexOf(",") + 1));
    const out = new Uint8Array(text.length);
    for (let i = 0; i < text.length; i++) out[i] = text.charCodeAt(i);
    return out.buffer;
  }

  function start(data) {
    const canvas = document.getElementById("view"), note = document.getElementById("view-note");
    const state = { ready: false, playing: true, speed: 1, look: "colour", filmed: false, clip: "", time: 0, duration: 0, listeners: [] };
    let renderer;
    try {
      renderer = new THREE.WebGLRenderer({ canvas, antialias: true, alpha: true, preserveDrawingBuffer: true });
    } catch (error) {
      note.textContent = "This browser offers no WebGL, so the model cannot be shown. Everything else on this page works; model.glb opens in other viewers.";
      return state;
    }
    renderer.setPixelRatio(Math.min(2, window.devicePixelRatio || 1));
    const scene = new THREE.Scene();
    const camera = new THREE.PerspectiveCamera(32, 1, 0.01, 200);
    const filmCamera = new THREE.PerspectiveCamera(40, 1, 0.01, 200);
    const sky = new THREE.HemisphereLight(0xffffff, 0xb9b2a8, 2.1);
    const sun = new THREE.DirectionalLight(0xffffff, 1.5);
    scene.add(sky); camera.add(sun); sun.position.set(-1.5, 2.5, 1.5); scene.add(camera);
    const controls = new THREE.OrbitControls(camera, canvas);
    controls.enableDamping = true; controls.dampingFactor = 0.08; controls.autoRotateSpeed = 1.6;
    let mixer = null, action = null, mesh = null, joints = [], lines = null, dots = null, gltf = null, ground = null, last = performance.now();
    const materials = {}, clips = {}, still = {};

    function fail(error) { note.textContent = "The model could not be shown: " + (error && error.message || error); state.error = String(error); }

    new THREE.GLTFLoader().parse(bytesOf(document.getElementById("model-data").textContent.trim()), "", (found) => {
      try { ready(found); } catch (error) { fail(error); }
    }, fail);

    function ready(found) {
      gltf = found;
      gltf.scene.traverse((o) => { if (o.isSkinnedMesh && !mesh) mesh = o; });
      if (!mesh) return fail("it has no skinned surface");
      mesh.frustumCulled = false;
      scene.add(gltf.scene);
      joints = mesh.skeleton.bones;
      looks();
      const box = new THREE.Box3().setFromBufferAttribute(mesh.geometry.attributes.position);
      const centre = box.getCenter(new THREE.Vector3()), size = box.getSize(new THREE.Vector3()).length();
      controls.target.copy(centre);
      camera.position.copy(centre).add(new THREE.Vector3(0.62, 0.3, 0.86).normalize().multiplyScalar(size * 1.22));
      controls.minDistance = size * 0.3; controls.maxDistance = size * 6; camera.near = size / 200; camera.far = size * 40;
      state.home = { position: camera.position.clone(), target: centre.clone() };
      sceneFloor(box, size);
      skeletonLines(size);
      mixer = new THREE.AnimationMixer(gltf.scene);
      for (const clip of gltf.animations) {
        const own = clip.clone(); own.tracks = own.tracks.filter((t) => !t.name.startsWith("root_motion."));
        clips[clip.name] = clip; still[clip.name] = own;
      }
      state.names = gltf.animations.map((a) => a.name);
      state.hasSeen = Boolean(seenAttribute());
      note.textContent = "";
      state.ready = true;
      choose(state.names[0] || "");
      for (const f of state.listeners) f("ready");
      requestAnimationFrame(frame);
    }

    function seenAttribute() { const a = mesh.geometry.attributes; return a._seen || a._views || null; }

    function looks() {
      const geometry = mesh.geometry, count = geometry.attributes.position.count;
      materials.colour = mesh.material;
      materials.colour.roughness = 1; materials.colour.metalness = 0;
      const flat = (paint) => {
        const colours = new Float32Array(3 * count);
        for (let v = 0; v < count; v++) { const c = paint(v); colours[3 * v] = linear(c[0]); colours[3 * v + 1] = linear(c[1]); colours[3 * v + 2] = linear(c[2]); }
        return new THREE.Float32BufferAttribute(colours, 3);
      };
      const sets = [0, 1, 2, 3].map((k) => [geometry.attributes["skinIndex" + (k || "")] || geometry.attributes["joints_" + k], geometry.attributes["skinWeight" + (k || "")] || geometry.attributes["weights_" + k]]).filter((s) => s[0] && s[1]);
      const palette = joints.map((_, j) => hue(j));
      state.attributes = { own: geometry.attributes.color || null };
      state.attributes.skin = flat((v) => {
        const c = [0, 0, 0]; let total = 1e-6;
        for (const [index, weight] of sets) for (let k = 0; k < 4; k++) {
          const w = weight.getComponent(v, k), p = palette[index.getComponent(v, k)];
          if (!p || !w) continue; c[0] += w * p.r; c[1] += w * p.g; c[2] += w * p.b; total += w;
        }
        return c.map((x) => x / total);
      });
      const seen = seenAttribute();
      if (seen) {
        let most = 0; for (let v = 0; v < count; v++) most = Math.max(most, seen.getX(v));
        state.mostSeen = most;
        state.attributes.seen = flat((v) => { const s = seen.getX(v); return s <= 0 ? [0.86, 0.22, 0.28] : ramp(Math.sqrt(s / Math.max(most, 1e-9))); });
      }
      const plain = () => new THREE.MeshStandardMaterial({ vertexColors: true, roughness: 0.95, metalness: 0, side: THREE.DoubleSide });
      materials.skin = plain(); materials.seen = plain(); materials.normals = new THREE.MeshNormalMaterial({ side: THREE.DoubleSide });
    }

    /* A soft shadow under the subject: a disc whose middle is dark, by vertex colours that fade into nothing. */
    function sceneFloor(box, size) {
      const disc = new THREE.CircleGeometry(size * 0.5, 64), count = disc.attributes.position.count, fade = new Float32Array(4 * count);
      for (let i = 0; i < count; i++) fade[4 * i + 3] = i === 0 ? 0.3 : 0;
      disc.setAttribute("color", new THREE.BufferAttribute(fade, 4));
      ground = new THREE.Mesh(disc, new THREE.MeshBasicMaterial({ vertexColors: true, transparent: true, depthWrite: false }));
      ground.rotation.x = -Math.PI / 2; ground.position.set(controls.target.x, box.min.y - 0.01 * size, controls.target.z); scene.add(ground);
    }

    function skeletonLines(size) {
      state.pairs = [];
      joints.forEach((bone, j) => { const p = joints.indexOf(bone.parent); if (p >= 0) state.pairs.push([p, j]); });
      const wire = new THREE.BufferGeometry(); wire.setAttribute("position", new THREE.BufferAttribute(new Float32Array(6 * state.pairs.length), 3));
      lines = new THREE.LineSegments(wire, new THREE.LineBasicMaterial({ color: 0x16181c, depthTest: false, transparent: true, opacity: 0.9 }));
      dots = new THREE.InstancedMesh(new THREE.SphereGeometry(size * 0.0085, 12, 8), new THREE.MeshBasicMaterial({ depthTest: false, transparent: true }), joints.length);
      joints.forEach((_, j) => dots.setColorAt(j, hue(j)));
      for (const o of [lines, dots]) { o.frustumCulled = false; o.renderOrder = 10; o.visible = false; scene.add(o); }
    }

    function moveBones() {
      const at = joints.map((b) => new THREE.Vector3().setFromMatrixPosition(b.matrixWorld));
      const place = lines.geometry.attributes.position;
      state.pairs.forEach(([a, b], i) => { place.setXYZ(2 * i, at[a].x, at[a].y, at[a].z); place.setXYZ(2 * i + 1, at[b].x, at[b].y, at[b].z); });
      place.needsUpdate = true;
      const m = new THREE.Matrix4(); at.forEach((p, j) => dots.setMatrixAt(j, m.makeTranslation(p.x, p.y, p.z)));
      dots.instanceMatrix.needsUpdate = true;
    }

    function choose(name) {
      state.clip = name;
      const held = state.filmed ? clips[name] : still[name];
      if (action) { mixer.stopAllAction(); action = null; }
      const root = gltf.scene.getObjectByName("root_motion");
      if (root) { root.position.set(0, 0, 0); root.quaternion.set(0, 0, 0, 1); }
      state.duration = held ? held.duration : 0;
      if (held) { action = mixer.clipAction(held); action.play(); seek(Math.min(state.time, state.duration)); }
      const film = gltf.cameras.find((c) => c.name === "camera_" + name) || gltf.cameras[(state.names || []).indexOf(name)];
      if (film) { filmCamera.fov = film.fov; state.aspect = film.aspect || 1; filmCamera.near = 0.01; }
      ground.visible = !state.filmed;
    }

    function seek(time) {
      state.time = time;
      if (action) { action.time = Math.min(time, Math.max(0, state.duration - 1e-4)); mixer.update(0); }
    }

    function setLook(name) {
      if (!materials[name] || (name === "seen" && !state.attributes.seen)) return;
      state.look = name;
      const own = name === "colour" ? state.attributes.own : state.attributes[name];
      if (own) mesh.geometry.setAttribute("color", own); else mesh.geometry.deleteAttribute("color");
      mesh.material = materials[name];
      mesh.material.wireframe = Boolean(state.wire);
      mesh.material.needsUpdate = true;
    }

    function setFilmed(on) { state.filmed = on; state.time = Math.min(state.time, state.duration); choose(state.clip); controls.enabled = !on; }

    function frame(now) {
      const passed = Math.min(0.1, (now - last) / 1000); last = now;
      if (state.playing && state.duration > 0) { state.time = (state.time + passed * state.speed) % state.duration; seek(state.time); for (const f of state.listeners) f("time"); }
      draw();
      requestAnimationFrame(frame);
    }

    function draw() {
      const width = canvas.clientWidth, height = canvas.clientHeight, ratio = renderer.getPixelRatio();
      if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) renderer.setSize(width, height, false);
      const eye = state.filmed ? filmCamera : camera;
      eye.aspect = width / Math.max(1, height);
      if (state.filmed) { const fit = filmCamera.userData.fov || (filmCamera.userData.fov = filmCamera.fov); eye.fov = filmCamera.fov; }
      eye.updateProjectionMatrix();
      controls.update();
      if (lines && lines.visible) { gltf.scene.updateMatrixWorld(true); moveBones(); }
      renderer.render(scene, eye);
    }

    Object.assign(state, {
      choose, seek, setLook, setFilmed, draw, names: [],
      setBones(on) { lines.visible = dots.visible = on; }, setWire(on) { state.wire = on; mesh.material.wireframe = on; },
      setTurn(on) { controls.autoRotate = on; }, on(f) { state.listeners.push(f); if (state.ready) f("ready"); },
    });
    return state;
  }
  return { start, LOOKS, ramp };
})();
