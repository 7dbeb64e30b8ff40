"use strict";
const $ = (id) => document.getElementById(id);
const MOST = 4000, PHASES = ["settle", "hold", "lead-in", "pump off", "contact", "release"];
let rows = [], posterior = [], m = {}, here = false, picked = 0, asked = "", phase = "", longest = 1, drawn = 0;
const hover = {};

history.replaceState(null, "", "/");
const source = new EventSource("/events");
source.onmessage = (event) => {
  const got = JSON.parse(event.data);
  const columns = JSON.stringify(got.columns) !== JSON.stringify(m.columns);
  if (got.all || columns || (got.rows.length && rows.length && got.rows[0][0] < rows[rows.length - 1][0])) rows = [];
  rows = rows.concat(got.rows);
  if (rows.length > MOST) rows = rows.filter((_, k) => k >= MOST / 2 || k % 2 === 0);
  posterior = got.posterior;
  m = got;
  here = true;
  if (m.ended) source.close();
  show();
};
source.onerror = () => { if (!m.ended) { here = false; show(); } };

function status(now) {
  if (!here) return ["✖", m.lost ? "session lost, and this page's server too" : "this page's server is gone", "bad"];
  if (m.lost) return ["✖", "session lost", "bad"];
  if (now.trip) return ["⚠", m.question ? "tripped, waiting for you" : "tripped", "bad"];
  if (m.ended) return ["settled", "played", "done"].includes(m.ended) ? ["✓", "ended: " + m.ended, "good"] : ["■", "ended: " + m.ended, "warn"];
  if (m.question) return ["❚❚", "waiting for you", "warn"];
  if (m.stopping) return ["■", "stopping", "warn"];
  if (!now.phase) return ["…", "starting", ""];
  if (now.verdict) return [now.verdict === "not settled" ? "✖" : "✓", now.verdict, now.verdict === "not settled" ? "warn" : "good"];
  if (m.age > 3 + 2 * (now.dt || 0)) return ["…", "no sample for " + m.age.toFixed(0) + " s", "bad"];
  return ["▶", "running", ""];
}

function text(id, words) { if ($(id).textContent !== words) $(id).textContent = words; }
function fixed(value, n, more = "") { return value === null || value === undefined ? "lost" : value.toFixed(n) + more; }
function unit(name) { return { "1": "", percent: " %", "0_255": " / 255" }[m.now.units[name]] ?? " " + m.now.units[name]; }

function show() {
  const now = m.now || {}, [icon, word, tone] = status(now);
  text("title", "thermogrip " + (m.title || ""));
  text("icon", icon); text("word", word);
  $("status").className = tone;
  document.title = icon + " " + word + " – thermogrip";
  $("lost").hidden = !(m.lost || (!here && m.title));
  if (m.lost) text("lost-text", "Its process ended without a word (killed, or the computer froze it). " + watchdog(now));
  else text("lost-text", "This page has lost its server, which says nothing about the rig: look at the terminal. The session does not need the page and goes on.");
  const trip = now.trip;
  $("trip").hidden = !trip;
  if (trip) {
    text("trip-kind", trip.kind + ", " + trip.subject);
    for (const name of ["expected", "measured", "check", "clear"]) text("trip-" + name, trip[name]);
  }
  ask(m.question);
  const dead = !here || m.lost || Boolean(m.ended);
  for (const control of document.querySelectorAll("#stop, #question button")) control.disabled = dead;
  document.querySelector("#bad button").disabled = dead || !now.phase || Boolean(now.verdict);
  $("charts").hidden = $("happened").hidden = $("phase-box").hidden = !now.phase;
  if (!now.phase) return;
  countdown(now, dead);
  tiles(now);
  $("events").replaceChildren(...[...now.events].reverse().map((event) => {
    const item = document.createElement("li"), at = document.createElement("b");
    at.textContent = event.time_s.toFixed(1) + " s";
    item.append(at, event.kind === "tripped" ? "tripped, see above" : event.kind + ": " + event.text);
    return item;
  }));
  if (!drawn) drawn = requestAnimationFrame(draw);
}

function watchdog(now) {
  if (!("expires_s" in now)) return "";
  if (now.expires_s === null) return "Nothing on this device ends its drive: PULL THE PLUG of its supply.";
  if (now.expires_s === 0) return "The rig was simulated: nothing is driven.";
  return "The device switches drive and pump off by itself, at most " + now.expires_s + " s after the last order: the drive is zero now.";
}

function countdown(now, dead) {
  const left = Math.max(now.left_s ?? 0, 0), name = now.phase + (m.what || "");
  if (name !== phase) { phase = name; longest = 0; }
  longest = Math.max(longest, left, 1e-9);
  const over = dead || now.verdict;
  text("phase", now.verdict || now.phase.replace("_", " "));
  text("left", over || now.left_s === null ? "" : (now.phase === "contact" ? left.toFixed(1) + " s left" : left.toFixed(0) + " s left at most"));
  text("what", over && !m.question ? "" : m.what || "");
  $("bar").hidden = Boolean(over);
  $("bar").value = 1 - left / longest;
}

function tiles(now) {
  const gone = m.lost && now.expires_s !== null, kept = m.lost && now.expires_s === null;
  const found = [[now.skin, fixed(now.values[now.skin], 2, " °C")]];
  for (const [name, value] of Object.entries(now.target)) found.push(["target of " + name, value.toFixed(1) + " °C", now.band === null ? "" : "± " + now.band]);
  for (const [name, value] of Object.entries(now.values)) if (name !== now.skin) found.push([name, fixed(value, 2, " °C")]);
  for (const [name, value] of Object.entries(now.drive)) found.push([name, gone ? "0" : kept ? "not known" : value.toFixed(2) + unit(name), gone ? "expired" : ""]);
  if (now.pump !== null) found.push(["pump", gone ? "off" : kept ? "not known" : now.pump ? "on" : "off"]);
  if (now.margin !== null) found.push(["guard margin", now.margin.toFixed(1) + " K", "to the limit of " + now.nearest]);
  if (now.model_share !== null) found.push(["beside the model", (100 * now.model_share).toFixed(0) + " %", "of what is allowed"]);
  $("tiles").replaceChildren(...found.map(([name, value, more]) => {
    const box = document.createElement("div"), dt = document.createElement("dt"), dd = document.createElement("dd");
    dt.textContent = name; dd.textContent = value;
    if (more) { const small = document.createElement("small"); small.textContent = " " + more; dd.append(small); }
    box.append(dt, dd);
    return box;
  }));
}

function ask(question) {
  $("question").hidden = !question;
  const key = question ? String(question.number) : "";
  if (key === asked) return;
  asked = key;
  if (!question) return;
  text("question-text", m.now.trip ? "Is it cleared?" : question.text);
  $("choices").replaceChildren(...question.choices.map(([said, shown]) => {
    const button = document.createElement("button");
    button.textContent = shown;
    button.onclick = () => send("answer", { question: key, text: said });
    return button;
  }));
  $("own").hidden = !question.own_words;
  text("own-label", question.own_words);
  $("own-text").value = "";
}

async function send(what, content) {
  let words = "";
  try {
    const answer = await fetch("/" + what, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(content || {}) });
    words = answer.ok ? { stop: "Stop is asked for.", bad: "Marked as bad.", answer: "Sent." }[what] : "Refused: " + (await answer.text());
  } catch (error) { words = "Not sent: this page's server is gone."; }
  text("answered", words);
}
$("stop").onclick = () => send("stop");
$("bad").onsubmit = (event) => { event.preventDefault(); send("bad", { text: $("why").value }); };
$("own").onsubmit = (event) => { event.preventDefault(); send("answer", { question: asked, text: $("own-text").value }); };
for (const button of document.querySelectorAll("[data-span]")) button.onclick = () => { picked = Number(button.dataset.span); draw(); };

function draw() {
  drawn = 0;
  const now = m.now;
  if (!now || !rows.length) return;
  const touching = ["lead_in", "pump_off", "contact"].includes(now.phase);
  const seconds = picked || (touching ? 30 : 300), last = rows[rows.length - 1][0];
  for (const button of document.querySelectorAll("[data-span]")) button.setAttribute("aria-pressed", String(Number(button.dataset.span) === seconds));
  const from = Math.max(last - seconds, rows[0][0]), shown = rows.filter((row) => row[0] >= from);
  const at = (name) => m.columns.indexOf(name);
  const line = (name, k, more) => ({ name, color: "--s" + (k % 6), points: shown.map((row) => [row[0], row[at(name)]]), ...more });
  const skin = [line(now.skin, 0)];
  if (now.skin in now.target) skin.unshift(line("target", 1, { dash: [6, 4], band: now.band, name: "target" }));
  const names = Object.keys(now.values).filter((name) => name !== now.skin), drives = Object.keys(now.drive);
  chart("skin", skin, "°C", from, last);
  chart("other", names.map((name, k) => line(name, k + 2)), "°C", from, last);
  chart("drive", drives.map((name, k) => line(name, k, { steps: true })), drives.length ? unit(drives[0]).trim() : "", from, last, 0);
  const earlier = !now.verdict && ["settle", "hold"].includes(now.phase);  // of the trial before
  $("posterior").hidden = earlier || !posterior.length;
  if (!$("posterior").hidden) materials();
}

function materials() {
  const newest = posterior[posterior.length - 1][1], known = Object.keys(newest), color = (name) => "--s" + (known.indexOf(name) % 6);
  const best = Object.entries(newest).sort((a, b) => (b[1] ?? 0) - (a[1] ?? 0)).slice(0, 5);
  $("materials").replaceChildren(...best.flatMap(([name, p]) => {
    const cells = ["span", "span", "i"].map((tag) => document.createElement(tag));
    cells[0].textContent = name; cells[1].textContent = p === null ? "–" : (100 * p).toFixed(0) + " %";
    cells[2].style.width = 100 * (p ?? 0) + "%"; cells[2].style.background = "var(" + color(name) + ")";
    return cells;
  }));
  const lines = best.map(([name]) => ({ name, color: color(name), points: posterior.map(([t, p]) => [t, p[name] === null ? null : 100 * p[name]]) }));
  chart("posterior", lines, "%", 0, Math.max(posterior[posterior.length - 1][0], 1), 0, 100);
}

function ticks(low, high, n) {
  const rough = (high - low) / n, power = 10 ** Math.floor(Math.log10(rough));
  const step = power * [1, 2, 5, 10].find((k) => k * power >= 0.999 * rough), found = [];
  for (let v = Math.ceil(low / step) * step; v <= high + 1e-9 * step; v += step) found.push(Math.round(v / step) * step);
  return [found, Math.max(0, -Math.floor(Math.log10(step) + 1e-9))];
}

function thin(points, columns) {
  if (points.length < 3 * columns) return points;
  const size = Math.ceil(points.length / columns), found = [];
  for (let k = 0; k < points.length; k += size) {
    const part = points.slice(k, k + size), known = part.filter((p) => p[1] !== null);
    if (!known.length) { found.push(part[0]); continue; }
    const low = known.reduce((a, b) => (b[1] < a[1] ? b : a)), high = known.reduce((a, b) => (b[1] > a[1] ? b : a));
    found.push(...(low[0] <= high[0] ? [low, high] : [high, low]));
  }
  return found;
}

function chart(id, lines, unitOf, from, to, ...must) {
  const canvas = $("c-" + id), box = canvas.getBoundingClientRect(), scale = devicePixelRatio || 1;
  canvas.hidden = !lines.length;
  if (!lines.length) return;
  if (canvas.width !== Math.round(box.width * scale)) { canvas.width = Math.round(box.width * scale); canvas.height = Math.round(box.height * scale); }
  const style = getComputedStyle(document.documentElement), color = (name) => style.getPropertyValue(name).trim();
  const g = canvas.getContext("2d"), left = 46, right = 8, top = 18, bottom = 20;
  const known = [...must, ...lines.flatMap((l) => l.points.map((p) => p[1]).filter((v) => v !== null && v !== undefined))];
  for (const l of lines) if (l.band) for (const p of l.points) if (p[1] !== null) known.push(p[1] - l.band, p[1] + l.band);
  let low = Infinity, high = -Infinity;
  for (const v of known) { if (v < low) low = v; if (v > high) high = v; }
  if (!(high >= low)) [low, high] = [0, 1];
  const pad = Math.max(0.06 * (high - low), 0.05); low -= must.includes(low) && low === 0 ? 0 : pad; high += pad;
  to = Math.max(to, from + 1);
  const X = (t) => left + (t - from) / (to - from) * (box.width - left - right);
  const Y = (v) => top + (high - v) / (high - low) * (box.height - top - bottom);
  g.setTransform(scale, 0, 0, scale, 0, 0);
  g.clearRect(0, 0, box.width, box.height);
  g.font = "12px system-ui, sans-serif"; g.lineWidth = 1; g.strokeStyle = color("--line"); g.fillStyle = color("--soft");
  const [ys, yd] = ticks(low, high, box.height < 160 ? 4 : 5), [xs, xd] = ticks(from, to, Math.max(4, box.width / 120));
  g.textAlign = "right"; g.textBaseline = "middle";
  for (const v of ys) { g.beginPath(); g.moveTo(left, Y(v)); g.lineTo(box.width - right, Y(v)); g.stroke(); g.fillText(v.toFixed(yd), left - 5, Y(v)); }
  g.textAlign = "center"; g.textBaseline = "top";
  for (const t of xs) if (X(t) < box.width - 26) g.fillText(t.toFixed(xd) + " s", X(t), box.height - bottom + 5);
  let at = left; g.textAlign = "left"; g.textBaseline = "alphabetic";
  g.fillText(unitOf && "[" + unitOf + "]", 4, 11);
  for (const l of lines) {
    g.fillStyle = g.strokeStyle = color(l.color); g.lineWidth = 2; g.setLineDash(l.dash || []);
    g.beginPath(); g.moveTo(at, 8); g.lineTo(at + 18, 8); g.stroke(); g.setLineDash([]);
    g.fillText(l.name, at + 22, 12); at += 34 + g.measureText(l.name).width;
  }
  g.save(); g.beginPath(); g.rect(left, top, box.width - left - right, box.height - top - bottom); g.clip();
  for (const l of lines) {
    const points = thin(l.points, box.width);
    if (l.band) {
      const there = points.filter((p) => p[1] !== null);
      g.fillStyle = color("--band");
      g.beginPath();
      for (const [t, v] of there) g.lineTo(X(t), Y(v + l.band));
      for (const [t, v] of there.reverse()) g.lineTo(X(t), Y(v - l.band));
      g.fill();
    }
    g.strokeStyle = color(l.color); g.lineWidth = 1.8; g.setLineDash(l.dash || []);
    g.beginPath();
    let open = false, before = 0;
    for (const [t, v] of points) {
      if (v === null || v === undefined) { open = false; continue; }
      if (open && l.steps) g.lineTo(X(t), Y(before));
      if (open) g.lineTo(X(t), Y(v)); else g.moveTo(X(t), Y(v));
      open = true; before = v;
    }
    g.stroke(); g.setLineDash([]);
  }
  g.restore();
  canvas.onpointermove = (event) => { hover[id] = event.offsetX; draw(); };
  canvas.onpointerleave = () => { delete hover[id]; draw(); };
  let words = "";
  if (id in hover) {
    const t = from + (hover[id] - left) / (box.width - left - right) * (to - from);
    const near = (points) => points.reduce((a, b) => (Math.abs(b[0] - t) < Math.abs(a[0] - t) ? b : a));
    const first = near(lines[0].points);
    g.strokeStyle = color("--soft"); g.lineWidth = 1; g.beginPath(); g.moveTo(X(first[0]), top); g.lineTo(X(first[0]), box.height - bottom); g.stroke();
    words = first[0].toFixed(1) + " s: " + lines.map((l) => l.name + " " + fixed(near(l.points)[1], 2)).join(", ") + (unitOf && " " + unitOf);
  }
  text("r-" + id, words);
}
addEventListener("resize", () => draw());
matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => draw());
show();
