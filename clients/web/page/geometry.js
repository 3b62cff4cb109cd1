// Metres, degrees and boxes.

/** Metres of one degree of latitude, on the sphere that web mercator takes the earth for. */
const METRES_PER_DEGREE = 111319.490793;

/**
 * A coordinate of a session's own frame, placed at 0, 0: there web mercator keeps distances and angles.
 * `[x east, y north, z]` in metres becomes `[longitude, latitude]` in degrees.
 */
export function placeLocal([x, y]) {
  return [x / METRES_PER_DEGREE, y / METRES_PER_DEGREE];
}

/** A GeoJSON geometry of lines in metres, placed at 0, 0. */
export function placeLocalGeometry({ type, coordinates }) {
  const line = (points) => points.map(placeLocal);
  return { type, coordinates: type === "MultiLineString" ? coordinates.map(line) : line(coordinates) };
}

/** A box `[west, south, east, north]` in metres, placed at 0, 0. */
export function placeLocalBox([west, south, east, north]) {
  return [...placeLocal([west, south]), ...placeLocal([east, north])];
}

/** The smallest box around boxes, or `undefined` where there is none. Boxes over the antimeridian are not joined. */
export function joinBoxes(boxes) {
  if (boxes.length === 0) return undefined;
  return [0, 1, 2, 3].map((side) => (side < 2 ? Math.min : Math.max)(...boxes.map((box) => box[side])));
}

/** Distance on the ground between two places `[longitude, latitude]` near each other, metres; heights aside. */
export function distance(from, to) {
  const latitude = ((from[1] + to[1]) / 2) * (Math.PI / 180);
  return METRES_PER_DEGREE * Math.hypot((to[0] - from[0]) * Math.cos(latitude), to[1] - from[1]);
}

/** Length on the ground of a GeoJSON geometry of lines, metres; heights aside. */
export function lengthOf({ type, coordinates }) {
  const lines = type === "MultiLineString" ? coordinates : [coordinates];
  const lengths = lines.flatMap((line) => line.slice(1).map((to, index) => distance(line[index], to)));
  return lengths.reduce((sum, length) => sum + length, 0);
}

/** The dashes of a GeoJSON geometry of lines: `dashM` metres of every `dashM + gapM`, after half a gap. */
export function dashesOf({ type, coordinates }, dashM, gapM) {
  const dashes = [];
  for (const line of type === "MultiLineString" ? coordinates : [coordinates]) {
    // How far it is to where paint begins or ends.
    let [dash, leftM] = [undefined, gapM / 2];
    for (let index = 1; index < line.length; index += 1) {
      const [from, to] = [line[index - 1], line[index]];
      const lengthM = distance(from, to);
      let wayM = 0;
      while (lengthM - wayM > leftM) {
        wayM += leftM;
        const place = [0, 1].map((axis) => from[axis] + ((to[axis] - from[axis]) * wayM) / lengthM);
        if (dash) dashes.push([...dash, place]);
        [dash, leftM] = dash ? [undefined, gapM] : [[place], dashM];
      }
      leftM -= lengthM - wayM;
      dash?.push(to);
    }
    if (dash?.length > 1) dashes.push(dash);
  }
  return { type: "MultiLineString", coordinates: dashes };
}

/** The smallest box `[west, south, east, north]` around the coordinates of GeoJSON geometries, or `undefined`. */
export function boxOf(geometries) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  const visit = (coordinates) => {
    if (typeof coordinates[0] !== "number") return coordinates.forEach(visit);
    const [x, y] = coordinates;
    return Object.assign(box, [Math.min(box[0], x), Math.min(box[1], y), Math.max(box[2], x), Math.max(box[3], y)]);
  };
  for (const geometry of geometries) visit(geometry.coordinates ?? []);
  return box[0] <= box[2] ? box : undefined;
}

/** Degrees of latitude, and of longitude at `latitude`, that `metres` span. */
export function degreesOf(metres, latitude) {
  const north = metres / METRES_PER_DEGREE;
  return { north, east: north / Math.cos((latitude * Math.PI) / 180) };
}

/** Metres on the ground that one pixel spans at a zoom, at a latitude (MapLibre's world is 512 pixels at zoom 0). */
export function metresPerPixel(zoom, latitude) {
  return ((360 * METRES_PER_DEGREE) / 512 / 2 ** zoom) * Math.cos((latitude * Math.PI) / 180);
}
