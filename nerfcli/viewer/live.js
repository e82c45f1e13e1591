// A page that its server keeps up to date: who draws, and each newer field of a training.
"use strict";

const POLL_MS = 2000;

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
  scene.version = head.version;
}

async function drawNewest(page) {
  await fetchField(page.scene);
  if (!page.renderer.gl.isContextLost()) page.renderer.load();
  page.request();
}

/** Fetch the proof of the newest field; return that field's version. */
async function fetchProof(scene) {
  const { head, arrays } = await fetchArrays("proof");
  Object.assign(scene, { proof: head.proof, expected: new Float32Array(arrays.expected.buffer) });
  return head.version;
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
  let page;
  scene.version = scene.live.version;
  try {
    if (by === "page") await fetchField(scene);
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
  follow(page, by);
}

/** Show each newer field; of those that the server draws, when the picture of the one before is complete. */
async function follow(page, by) {
  const { scene } = page;
  for (;;) {
    document.body.dataset.version = scene.version;
    await new Promise(resolve => setTimeout(resolve, POLL_MS));
    try {
      const newest = await (await fetch("version")).json();
      if (newest === scene.version || by === "server" && !page.done) continue;
      if (by === "page") await drawNewest(page);
      else {
        scene.version = page.renderer.version = newest;
        page.request();
      }
    } catch (error) {
      $("status").textContent = `no newer field from the server: ${error.message}`;
    }
  }
}
