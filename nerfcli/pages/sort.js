// Tables of the class "sortable": a click on a heading sorts by its column, a second one the other way round.
(function () {
  "use strict";
  function value(row, column) {
    var text = row.cells[column].textContent.trim(), number = parseFloat(text.replace(/,/g, ""));
    return isNaN(number) ? text.toLowerCase() : number;
  }

  function compare(a, b) {
    if (typeof a === typeof b) { return a < b ? -1 : a > b ? 1 : 0; }
    return typeof a === "number" ? -1 : 1;  // what has no number comes last
  }

  document.querySelectorAll("table.sortable").forEach(function (table) {
    var headings = table.querySelectorAll("th");
    headings.forEach(function (heading, column) {
      var button = heading.querySelector("button");
      if (!button) { return; }
      button.addEventListener("click", function () {
        var falling = heading.getAttribute("aria-sort") === "ascending", body = table.tBodies[0];
        headings.forEach(function (other) { other.removeAttribute("aria-sort"); });
        heading.setAttribute("aria-sort", falling ? "descending" : "ascending");
        Array.from(body.rows).sort(function (a, b) {
          var order = compare(value(a, column), value(b, column));
          return falling ? -order : order;
        }).forEach(function (row) { body.appendChild(row); });
      });
    });
  });
})();
