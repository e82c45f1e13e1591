// Two pictures over each other with a line between them that moves: .compare elements with a data-view.
(function () {
  "use strict";
  var data = JSON.parse(document.getElementById("views").textContent);

  function option(select, label, value) {
    var item = document.createElement("option");
    item.textContent = label;
    item.value = value;
    select.appendChild(item);
  }

  document.querySelectorAll(".compare").forEach(function (box) {
    var layers = data[Number(box.dataset.view)];
    var images = box.querySelectorAll("img"), selects = box.querySelectorAll("select");
    var slider = box.querySelector("input"), stage = box.querySelector(".stage"), line = box.querySelector(".line");
    selects.forEach(function (select, side) {
      layers.forEach(function (layer, index) { option(select, layer.label, index); });
      select.value = Math.min(side, layers.length - 1);
      select.addEventListener("change", show);
    });
    function show() {
      selects.forEach(function (select, side) {
        var layer = layers[Number(select.value)];
        images[side].src = layer.uri;
        images[side].alt = layer.label;
      });
    }
    function move() {
      images[0].style.clipPath = "inset(0 " + (100 - slider.value) + "% 0 0)";
      line.style.left = slider.value + "%";
    }
    function follow(event) {
      var place = stage.getBoundingClientRect();
      slider.value = Math.max(0, Math.min(100, 100 * (event.clientX - place.left) / place.width));
      move();
    }
    stage.addEventListener("pointerdown", function (event) { stage.setPointerCapture(event.pointerId); follow(event); });
    stage.addEventListener("pointermove", function (event) { if (event.buttons) { follow(event); } });
    slider.addEventListener("input", move);
    show();
    move();
  });
})();
