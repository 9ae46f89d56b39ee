// Starts Rerun's viewer and hands it one part of the live view after another, as it asks for them.
"use strict";

const PERIOD_MS = 300;
const AGAIN_MS = 1000;
const CHANNEL = "station";

const say = (text) => {
  const element = document.getElementById("say");
  element.textContent = text;
  element.hidden = !text;
};
const pause = (time_ms) => new Promise((done) => setTimeout(done, time_ms));

// While the station prepares the viewer it answers 503 and says why.
async function viewerFile(name) {
  for (;;) {
    const answer = await fetch(`/viewer/${name}`).catch(() => null);
    if (answer?.ok) return answer;
    say(answer ? await answer.text() : "The station does not answer.");
    await pause(AGAIN_MS);
  }
}

async function script(name) {
  await viewerFile(name);
  await new Promise((done, failed) => {
    const element = document.createElement("script");
    element.src = `/viewer/${name}`;
    element.onload = done;
    element.onerror = () => failed(new Error(`${name} cannot be loaded`));
    document.body.append(element);
  });
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
    const answer = await fetch(`/api/view?after=${encodeURIComponent(place)}`).catch(() => null);
    if (answer?.status === 200) {
      const data = new Uint8Array(await answer.arrayBuffer());
      place = answer.headers.get("Palpate-Place");
      viewer.send_rrd_to_channel(CHANNEL, data);
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
