// Starts the viewer of the splats inside this page.
const scene = JSON.parse(document.getElementById("scene").textContent), first = scene.first;
// The viewer takes the angle along the longer side of the window; the page states the vertical one.
first.fov = 360 / Math.PI * Math.atan(Math.max(1, innerWidth / innerHeight) * Math.tan(first.fov * Math.PI / 360));
const effects = ["sharpness", "bloom", "grading", "vignette", "fringing"].map(name => [name, {enabled: false}]);
const settings = {
  version: 2, tonemapping: "none", highPrecisionRendering: false, background: {color: scene.background},
  postEffectSettings: Object.fromEntries(effects), animTracks: [], cameras: [{initial: first}], annotations: [],
  startMode: "default",
};
const options = {
  container: document.getElementById("stage"), settings, noanim: true,
  renderer: new URLSearchParams(location.search).has("webgl") ? "webgl" : "webgpu",
  contentUrl: "splats.ply", contents: bytesOf("splats").then(bytes => new Response(bytes)),
};
const started = viewer => viewer.events.once("loaded:changed", () => {
  viewer.state.cameraMode = "orbit";
  document.body.dataset.state = "ready";
});
const failed = error => {
  if (document.body.dataset.state) return;
  document.body.dataset.state = "failed";
  document.body.replaceChildren(`This browser cannot show the splats: ${error}`);
};
// What the viewer does not catch: without WebGL its promise is never settled.
addEventListener("error", event => failed(event.message));
addEventListener("unhandledrejection", event => failed(event.reason));
// A module inside the page, as browsers load no other module from the disk.
bytesOf("viewer").then(bytes => {
  const script = document.createElement("script");
  script.type = "module";
  script.textContent = new TextDecoder().decode(bytes) + "\ncreateViewer(options).then(started, failed);";
  document.body.append(script);
}).catch(failed);
