// The status of the station, asked for each second. Everything that comes from it is shown as text.
"use strict";

const PERIOD_MS = 1000;
const PATIENCE_MS = 4000;
const SHOWN = "#with-live-view";

const COLOURS = {
  ready: "good", live: "good", routes: "good",
  finished: "done", ended: "done",
  degraded: "bad", missing: "bad", silent: "bad", lost: "bad", zero_lost: "bad",
};
const WORDS = { silent: "does not answer" };

const at = (id) => document.getElementById(id);
const number = (value, digits = 0) => (value === null || value === undefined ? "–" : value.toFixed(digits));
const ms = (seconds) => (seconds === null || seconds === undefined ? "–" : (1e3 * seconds).toFixed(1));

function duration(seconds) {
  if (seconds === null || seconds === undefined) return "–";
  if (seconds < 60) return `${seconds.toFixed(0)} s`;
  const whole = Math.floor(seconds);
  const rest = String(whole % 60).padStart(2, "0");
  const minutes = Math.floor(whole / 60);
  if (minutes < 60) return `${minutes}:${rest}`;
  return `${Math.floor(minutes / 60)}:${String(minutes % 60).padStart(2, "0")}:${rest}`;
}

function size(bytes) {
  if (bytes === null || bytes === undefined) return "–";
  const units = ["B", "kB", "MB", "GB", "TB"];
  let unit = 0;
  while (bytes >= 1000 && unit < units.length - 1) { bytes /= 1000; unit += 1; }
  return `${bytes.toFixed(unit && bytes < 100 ? 1 : 0)} ${units[unit]}`;
}

function state(name) {
  const words = WORDS[name] ?? name.replaceAll("_", " ");
  return { text: words, kind: `word ${COLOURS[name] ?? "waiting"}` };
}
const right = (text) => ({ text, kind: "number" });
const wide = (text) => ({ text, kind: "text" });

function table(id, heads, rows, none) {
  const element = at(id);
  const lines = [];
  const line = (cells, tag) => {
    const row = document.createElement("tr");
    for (const one of cells) {
      const cell = document.createElement(tag);
      cell.textContent = one.text ?? one;
      if (one.kind) cell.className = one.kind;
      row.append(cell);
    }
    lines.push(row);
  };
  if (rows.length) {
    line(heads, "th");
    rows.forEach((row) => line(row, "td"));
  } else {
    line([{ text: none, kind: "none" }], "td");
  }
  element.replaceChildren(...lines);
}

const named = (one) => (one.service === one.instance ? one.service : `${one.service}/${one.instance}`);

function show(status) {
  at("station").textContent = status.station;
  document.title = `${status.station} – palpate`;
  const all = status.processes.length + status.left_out;
  const whole = at("whole");
  const wrong = status.troubles.length;
  whole.textContent = `${status.well} of ${all} processes well${wrong ? `, ${wrong} wrong` : ""}${status.left_out ? `, ${status.left_out} not shown` : ""}`;
  whole.className = `word ${wrong ? "bad" : "good"}`;
  at("live").hidden = !status.live;
  const gone = "the router is gone. It starts again by itself, or with: palpate up";
  const nobody = "The station does not answer: its router is there, but no process of it. Start it with: palpate up";
  if (status.answers) alarm(status.router ? "" : `What is below still comes, but ${gone}`, false);
  else alarm(status.router ? nobody : `The station does not answer: ${gone}`);

  table("sensors",
    ["sensor", "state", right("for"), right("Hz"), right("told before"), right("p50 ms"), right("p99 ms"), right("tare age"), right("drift [counts]"), "says"],
    status.sensors.map((one) => [
      one.name, state(one.state), right(duration(one.state_age_s)), right(number(one.rate_hz, 1)), right(`${number(one.age_s, 1)} s`),
      right(ms(one.publish.p50_s)), right(ms(one.publish.p99_s)),
      one.tare_age_s === null && one.tactile ? { text: "not tared", kind: "number word waiting" } : right(duration(one.tare_age_s)),
      right(number(one.tare_drift_counts, 1)), wide(one.message),
    ]), "no gateway tells of a sensor");

  table("recordings",
    ["recorder", "state", right("this record"), right("per second"), right("all kept"), right("disk free"), "says"],
    status.recordings.map((one) => [
      one.instance, state(one.state), right(size(one.size_bytes)), right(size(one.bytes_per_s)),
      right(size(one.kept_bytes)), right(size(one.disk_free_bytes)), wide(one.message),
    ]), "nothing is recorded: no recorder runs");

  table("processes",
    ["process", "state", right("in/s"), right("out/s"), right("p50 ms"), right("p99 ms"), right("cpu %"), right("MB"), right("up"), right("restarts"), "models", "says"],
    status.processes.map((one) => {
      const whole = one.latencies.latency ?? {};
      const cpu = one.uses.cpu_ratio;
      const rss = one.uses.rss_bytes;
      return [
        named(one), state(one.state === "ready" && !one.ready ? "not ready" : one.state),
        right(number(one.in_hz)), right(number(one.out_hz)), right(ms(whole.p50_s)), right(ms(whole.p99_s)),
        right(number(cpu === null ? null : 100 * cpu)), right(number(rss === null ? null : 1e-6 * rss)),
        right(duration(one.uptime_s)), right(number(one.restarts)), one.models.join(" "), wide(one.message),
      ];
    }), "no process runs");

  const lines = [];
  for (const one of status.troubles) {
    const problem = document.createElement("dt");
    problem.textContent = `${named(one)}: ${one.problem}`;
    const remedy = document.createElement("dd");
    remedy.textContent = `fix: ${one.remedy}`;
    lines.push(problem, remedy);
  }
  at("troubles").replaceChildren(...lines);
  at("wrong").hidden = !wrong;
}

function alarm(text, old = true) {
  const element = at("alarm");
  if (element.textContent !== text) element.textContent = text;
  element.hidden = !text;
  document.body.classList.toggle("old", old && Boolean(text));
}

let heard = Date.now();

async function ask() {
  try {
    const answer = await fetch("/api/status", { signal: AbortSignal.timeout(PATIENCE_MS) });
    if (answer.status === 503) { // the server has just begun to look at the station
      at("whole").textContent = "is being looked at";
      at("whole").className = "word waiting";
    } else {
      if (!answer.ok) throw new Error(await answer.text());
      show(await answer.json());
      heard = Date.now();
      at("clock").textContent = `as of ${new Date().toLocaleTimeString()}`;
    }
  } catch (error) {
    const since = (Date.now() - heard) / 1e3;
    at("whole").textContent = "not known";
    at("whole").className = "word bad";
    alarm(`The station does not answer: nothing has come from this page's server for ${since.toFixed(0)} s. What is below is old.`);
  }
  setTimeout(ask, PERIOD_MS);
}

function showLive(on) {
  const button = at("live");
  button.textContent = on ? "Hide the live view" : "Show the live view";
  button.setAttribute("aria-expanded", String(on));
  const picture = at("picture");
  picture.hidden = !on;
  if (on && !picture.firstChild) {
    const frame = document.createElement("iframe");
    frame.src = "/live";
    frame.title = "live view";
    picture.append(frame);
  } else if (!on) {
    picture.replaceChildren(); // frees what the viewer holds
  }
}

at("live").addEventListener("click", () => { location.hash = location.hash === SHOWN ? "" : SHOWN; });
addEventListener("hashchange", () => showLive(location.hash === SHOWN));
showLive(location.hash === SHOWN);
ask();
