// Starts Rerun's viewer and hands it one part of the live view after another, as it asks for them.
"use strict";

const PERIOD_MS = 300;
const AGAIN_MS = 1000;
const PART_MS = 60000; // up to 4 MB
const FILE_MS = 600000; // 14 MB, once
const CHANNEL = "station";

const say = (text) => {
  const element = document.getElementById("say");
  element.textContent = text;
  element.hidden = !text;
};
const pause = (time_ms) => new Promise((done) => setTimeout(done, time_ms));

// An answer with all that it holds; null = it did not come, or not whole.
async function ask(address, patience_ms) {
  try {
    const answer = await fetch(address, { signal: AbortSignal.timeout(patience_ms) });
    return { status: answer.status, headers: answer.headers, data: await answer.arrayBuffer() };
  } catch {
    return null;
  }
}

// While the station prepares the viewer it answers 503 and says why.
async function viewerFile(name) {
  for (;;) {
    const answer = await ask(`/viewer/${name}`, FILE_MS);
    if (answer?.status === 200) return answer.data;
    say(answer ? new TextDecoder().decode(answer.data) : "The station does not answer.");
    await pause(AGAIN_MS);
  }
}

async function script(name) {
  for (;;) {
    await viewerFile(name);
    const loaded = await new Promise((done) => {
      const element = document.createElement("script");
      element.src = `/viewer/${name}`;
      element.onload = () => done(true);
      element.onerror = () => done(false);
      document.body.append(element);
    });
    if (loaded) return;
    say(`${name} cannot be loaded.`);
    await pause(AGAIN_MS);
  }
}

async function start() {
  await script("re_viewer.js");
  await wasm_bindgen({ module_or_path: await viewerFile("re_viewer_bg.wasm") });
  const viewer = new wasm_bindgen.WebHandle({
    hide_welcome_screen: true, persist: false, enable_history: false, notebook: false,
    render_backend: new URLSearchParams(location.search).get("renderer"),
  });
  await viewer.start(document.getElementById("view"));
  return viewer;
}

async function feed(viewer) {
  let place = "";
  let begun = false;
  viewer.open_channel(CHANNEL, CHANNEL);
  say("Waiting for the first picture …");
  while (!viewer.has_panicked()) {
    const answer = await ask(`/api/view?after=${encodeURIComponent(place)}`, PART_MS);
    if (answer?.status === 200) {
      place = answer.headers.get("Palpate-Place");
      viewer.send_rrd_to_channel(CHANNEL, new Uint8Array(answer.data));
      if (!begun) { begun = true; say(""); }
    } else {
      await pause(answer?.status === 204 ? PERIOD_MS : AGAIN_MS);
    }
  }
  throw new Error(viewer.panic_message());
}

start().then(feed).catch((error) => {
  console.error(error);
  say(`The viewer has ended: ${String(error?.message ?? error).slice(0, 300)} – load this page again to start it anew.`);
});
