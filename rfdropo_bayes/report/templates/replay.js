"use strict";
// Measured against simulated in three dimensions: drag to turn, play, move to any instant. Positions are tenths of a millimetre.
for (const root of document.querySelectorAll(".replay")) {
  const data = JSON.parse(root.querySelector("script[type='application/json']").textContent);
  const canvas = root.querySelector("canvas"), pen = canvas.getContext("2d");
  const choice = root.querySelector("select"), play = root.querySelector("button"), at = root.querySelector("input"), words = root.querySelector("output");
  const hidden = new Set();
  const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
  const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
  const unit = (a) => { const n = Math.hypot(...a) || 1; return a.map((v) => v / n); };
  // A frame with its third axis upwards, its first along the robot's axis where that lies across.
  const gravity = data.outline ? data.outline.gravity : [0, 0, -1];
  const up = Math.hypot(...gravity) ? unit(gravity.map((v) => -v)) : [0, 0, 1];
  const seed = Math.abs(up[2]) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const ahead = unit(seed.map((v, i) => v - dot(seed, up) * up[i])), left = cross(up, ahead);
  const base = data.outline ? [data.outline.base] : [];
  // Measured, the last series (the model that counts), and what lies between them.
  const colour = (k) => (k === 0 ? "--ink" : k === names.length - 1 ? "--blue" : "--red");
  let track, names, frame = 0, playing = false, azimuth = 0.9, elevation = 0.35, began = 0, middle = [0, 0, 0], reach = 1;

  const point = (name, row, marker) => {
    const start = 3 * (row * track.markers.length + marker), values = track.series[name];
    return values[start] === null ? null : values.slice(start, start + 3);
  };
  const shape = (name, row) => [...base, ...track.markers.map((_, m) => point(name, row, m))].filter((p) => p !== null);
  const distance = (name) => {
    const last = track.markers.length - 1, measured = point("measured", frame, last), other = point(name, frame, last);
    return measured && other ? Math.hypot(...measured.map((v, i) => v - other[i])) / 10 : null;
  };
  function choose(index) {
    track = data.tracks[index]; names = Object.keys(track.series); frame = 0; at.max = track.time.length - 1; at.value = 0;
    const low = [Infinity, Infinity, Infinity], high = [-Infinity, -Infinity, -Infinity];
    for (const name of names) for (let row = 0; row < track.time.length; row++) for (const p of shape(name, row)) {
      p.forEach((v, i) => { low[i] = Math.min(low[i], v); high[i] = Math.max(high[i], v); });
    }
    middle = low.map((v, i) => (v + high[i]) / 2); reach = Math.hypot(...low.map((v, i) => high[i] - v)) / 2 || 1;
    began = 0; draw();
  }
  function view() {
    const [ca, sa, ce, se] = [Math.cos(azimuth), Math.sin(azimuth), Math.cos(elevation), Math.sin(elevation)];
    const scale = 0.46 * Math.min(canvas.clientWidth, canvas.clientHeight) / reach;
    return (p) => {
      const d = p.map((v, i) => v - middle[i]), x = dot(d, ahead), y = dot(d, left), z = dot(d, up);
      return [canvas.clientWidth / 2 + scale * (-sa * x + ca * y), canvas.clientHeight / 2 - scale * (ce * z - se * (ca * x + sa * y)), scale];
    };
  }
  function line(points, look, colour, width, alpha) {
    if (points.length < 2) return;
    pen.globalAlpha = alpha; pen.strokeStyle = colour; pen.lineWidth = width; pen.lineJoin = pen.lineCap = "round"; pen.beginPath();
    points.forEach((p, i) => { const [x, y] = look(p); if (i) pen.lineTo(x, y); else pen.moveTo(x, y); }); pen.stroke();
  }
  function draw() {
    const ratio = window.devicePixelRatio || 1, css = getComputedStyle(root), width = canvas.clientWidth, height = canvas.clientHeight;
    if (canvas.width !== Math.round(width * ratio)) { canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio); }
    pen.setTransform(ratio, 0, 0, ratio, 0, 0); pen.globalAlpha = 1; pen.clearRect(0, 0, width, height);
    const look = view(), scale = look(middle)[2], last = track.markers.length - 1;
    if (data.outline) {
      const wide = data.outline.half_width[0], ring = Array.from({ length: 49 }, (_, i) => [base[0][0] + 1.6 * wide * Math.cos(i * Math.PI / 24), base[0][1] + 1.6 * wide * Math.sin(i * Math.PI / 24), base[0][2]]);
      line(ring, look, css.getPropertyValue("--soft"), 2, 0.7);
    }
    names.forEach((name, k) => {
      if (hidden.has(name)) return;
      const tone = css.getPropertyValue(colour(k)).trim(), body = shape(name, frame);
      const trail = []; for (let row = Math.max(0, frame - 60); row <= frame; row++) { const p = point(name, row, last); if (p) trail.push(p); }
      line(trail, look, tone, 1, 0.55);
      if (data.outline && k === names.length - 1) line(body, look, tone, Math.max(2, 2 * scale * data.outline.half_width[data.outline.half_width.length - 1]), 0.16);
      line(body, look, tone, k ? 2 : 1.2, k ? 0.9 : 0.5);
      pen.globalAlpha = 1; pen.fillStyle = tone;
      track.markers.forEach((_, m) => { const p = point(name, frame, m); if (p) { const [x, y] = look(p); pen.beginPath(); pen.arc(x, y, k ? 3 : 4.5, 0, 7); pen.fill(); } });
    });
    pen.globalAlpha = 1;
    at.value = frame; canvas.dataset.frame = frame;
    words.textContent = `${track.time[frame].toFixed(2)} s` + names.slice(1).map((name) => { const d = distance(name); return d === null ? "" : `; ${name}: ${d.toFixed(1)} mm off at ${track.markers[last]}`; }).join("");
  }
  function tick(now) {
    if (!playing) return;
    began = began || now - 1000 * track.time[frame];
    const seconds = (now - began) / 1000;
    while (frame < track.time.length - 1 && track.time[frame + 1] <= seconds) frame++;
    if (seconds > track.time[track.time.length - 1] + 0.6) { frame = 0; began = now; }
    draw(); requestAnimationFrame(tick);
  }
  function run(on) { playing = on; play.textContent = on ? "Pause" : "Play"; began = 0; if (on) requestAnimationFrame(tick); }

  data.tracks.forEach((each, i) => choice.add(new Option(`${each.name} (${each.role})`, i)));
  const keys = root.querySelector(".keys");
  function legend() {
    keys.replaceChildren(...names.map((name, k) => {
      const key = document.createElement("button"); key.type = "button"; key.textContent = name; key.setAttribute("aria-pressed", !hidden.has(name));
      key.style.setProperty("--tone", `var(${colour(k)})`);
      key.onclick = () => { if (!hidden.delete(name)) hidden.add(name); legend(); draw(); };
      return key;
    }));
  }
  choice.onchange = () => { choose(+choice.value); legend(); };
  play.onclick = () => run(!playing);
  at.oninput = () => { run(false); frame = +at.value; draw(); };
  canvas.onpointerdown = (press) => {
    let [x, y] = [press.clientX, press.clientY]; canvas.setPointerCapture(press.pointerId);
    canvas.onpointermove = (move) => { azimuth -= (move.clientX - x) / 120; elevation = Math.max(-1.5, Math.min(1.5, elevation + (move.clientY - y) / 120)); [x, y] = [move.clientX, move.clientY]; draw(); };
    canvas.onpointerup = canvas.onpointercancel = () => { canvas.onpointermove = null; };
  };
  canvas.onkeydown = (key) => {
    const turn = { ArrowLeft: [0.1, 0], ArrowRight: [-0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[key.key];
    if (turn) { azimuth += turn[0]; elevation = Math.max(-1.5, Math.min(1.5, elevation + turn[1])); key.preventDefault(); draw(); }
  };
  new ResizeObserver(draw).observe(canvas);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  choose(0); legend();
  if (!matchMedia("(prefers-reduced-motion: reduce)").matches) run(true);
}
