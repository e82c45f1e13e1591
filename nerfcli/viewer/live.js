// A page that its server keeps up to date: who draws, new numbers of the field, the training's state and its buttons.
"use strict";

/** Bytes of the server's answer: length of the JSON, the JSON, its arrays. */
async function fetchArrays(place) {
  const answer = await fetch(place);
  if (!answer.ok) throw new Error(await answer.text());
  const buffer = await answer.arrayBuffer(), length = new DataView(buffer).getUint32(0, true);
  const head = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, length))), arrays = {};
  let at = 4 + length;
  for (const [name, size] of head.arrays) {
    arrays[name] = new Uint8Array(buffer.slice(at, at + size));
    at += size;
  }
  return { head, arrays };
}

async function fetchField(scene) {
  const { head, arrays } = await fetchArrays("field");
  Object.assign(scene, { field: head.field, march: head.march });
  withField(scene, arrays);
  return head.version;
}

async function fetchProof(scene) {
  const { head, arrays } = await fetchArrays("proof");
  Object.assign(scene, { proof: head.proof, expected: new Float32Array(arrays.expected.buffer) });
}

/** Who draws: "page" or "server", and why. */
function drawerOf({ refusal }) {
  const wanted = new URLSearchParams(location.search).get("by");
  if (refusal) return ["server", refusal];
  const gl = document.createElement("canvas").getContext("webgl2"), missing = whatIsMissing(gl);
  if (missing) return ["server", missing];
  const info = gl.getExtension("WEBGL_debug_renderer_info");
  const device = gl.getParameter(info ? info.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  if (wanted) return [wanted === "server" ? "server" : "page", device];
  const software = /swiftshader|llvmpipe|softpipe|software|basic render/i.test(device);
  return software ? ["server", `this browser draws without a graphics card (${device})`] : ["page", device];
}

async function startLive(scene) {
  const [by, why] = drawerOf(scene.live);
  let page, { version } = scene.live;
  try {
    if (by === "page") version = await fetchField(scene);
    else Object.assign(state, { scale: 0.5 });
    page = by === "page" ? startHere(scene) : show(scene, new Remote(scene, $("field")));
  } catch (error) {
    return trouble(`This page cannot be shown: ${error.message}`);
  }
  if (!page) return;
  $("drawing").hidden = false;
  $("by").value = by;
  $("by").disabled = Boolean(scene.live.refusal);
  $("why").textContent = why;
  $("by").addEventListener("change", () => { location.search = `?by=${$("by").value}`; });
  $("scale").value = state.scale;
  $("proof").hidden = by === "server";
  if (by === "server") Object.assign($("clip"), { disabled: true, title: "only where this device draws" });
  new Live(page, by, version);
}

class Live {
  constructor(page, by, version) {
    Object.assign(this, { page, by, version, busy: false, last: null });
    const events = new EventSource("events");
    events.onmessage = event => this.news(JSON.parse(event.data));
    events.onerror = () => {
      $("training").hidden = false;
      $("progress").textContent = "The server has ended. Start it again with nerfcli view; the address is then another one.";
      for (const id of ["pause", "stop"]) $(id).disabled = true;
    };
    $("pause").onclick = () => this.control(this.last?.state === "paused" ? "continue" : "pause");
    $("stop").onclick = () => { if (confirm("End the training? It saves a checkpoint; --resume goes on from it.")) this.control("stop"); };
  }

  async control(action) {
    const answer = await fetch("control", { method: "POST", body: JSON.stringify({ action }) });
    if (answer.ok) this.news(await answer.json());
  }

  news(status) {
    const { state: now, share, step, seconds, loss, version, stopping } = status;
    this.last = status;
    document.body.dataset.training = now;
    $("training").hidden = now === "none";
    $("done").value = share ?? 1;
    const numbers = step === undefined ? "" : `step ${step.toLocaleString("en")}, ${seconds.toFixed(0)} s, loss ${loss.toFixed(4)}`;
    const words = { training: stopping ? "Stopping" : "Training", paused: "Paused", ended: "The training has ended" }[now];
    $("progress").textContent = [words, numbers].filter(Boolean).join(": ");
    this.page.press("pause", now === "paused");
    $("pause").textContent = now === "paused" ? "Continue" : "Pause";
    for (const id of ["pause", "stop"]) $(id).disabled = now === "ended" || Boolean(stopping);
    if (version > this.version) this.take(version);
  }

  /** Show a newer field, when the picture of the one before is complete. */
  async take(version) {
    this.newest = version;
    if (this.busy) return;
    this.busy = true;
    while (this.newest > this.version) {
      try {
        if (this.by === "page") {
          this.version = Math.max(this.newest, await fetchField(this.page.scene));
          if (!this.page.renderer.gl.isContextLost()) this.page.renderer.load();
        } else {
          await this.rested();
          this.version = this.page.renderer.version = this.newest;
        }
        this.page.request();
      } catch (error) {
        $("status").textContent = `no new field from the server: ${error.message}`;
        await new Promise(resolve => setTimeout(resolve, 2000));
      }
    }
    this.busy = false;
    document.body.dataset.version = this.version;
  }

  async rested() {
    while (!this.page.done) await new Promise(resolve => setTimeout(resolve, 100));
  }
}
