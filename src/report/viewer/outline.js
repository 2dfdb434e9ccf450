// Rectangle and lasso over the picture.
import { find } from "splatvk/page";
import { make } from "splatvk/widgets";

/// Distance between corners of a lasso, CSS pixels, and most corners.
const SPACING = 4, MOST = 400;

/// A tool for [`takeDrags`]: `done` gets the corners of the outline, CSS pixels.
export function outliner(kind, done) {
  let points = [], drawn = null;
  const draw = () => drawn.firstChild.setAttribute("points", points.map((p) => p.map((v) => v.toFixed(1)).join(",")).join(" "));
  return {
    from(x, y) {
      points = [[x, y]];
      drawn = document.createElementNS("http://www.w3.org/2000/svg", "svg");
      drawn.setAttribute("class", "v-line v-outline");
      drawn.append(document.createElementNS("http://www.w3.org/2000/svg", "polygon"));
      find(".v-notes").after(drawn);
    },
    to(x, y) {
      const [first, last] = [points[0], points.at(-1)];
      if (kind === "rectangle") points = [first, [x, first[1]], [x, y], [first[0], y]];
      else if (Math.hypot(x - last[0], y - last[1]) >= SPACING) points.push([x, y]);
      // A long lasso loses every other corner.
      if (points.length > MOST) points = points.filter((_, k) => k % 2 === 0);
      draw();
    },
    end(isDone) {
      drawn?.remove();
      drawn = null;
      if (isDone && points.length > 2) done(points);
      points = [];
    },
  };
}
