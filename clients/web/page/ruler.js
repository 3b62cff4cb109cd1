// The ruler: metres between places that are clicked one after the other.

import { distance } from "./geometry.js";

export class Ruler {
  active = false;
  #places = [];
  #draw;
  #say;

  /** `draw(features)` puts what is measured on the map, `say(metres, count)` tells the length so far. */
  constructor(draw, say) {
    this.#draw = draw;
    this.#say = say;
  }

  toggle() {
    this.active = !this.active;
    this.#places = [];
    this.#show();
  }

  /** Takes a place that was clicked. */
  add(place) {
    this.#places.push(place);
    this.#show();
  }

  /** Shows the length to where the pointer is. */
  hover(place) {
    if (this.active && this.#places.length > 0) this.#show(place);
  }

  #show(next) {
    const line = next ? [...this.#places, next] : this.#places;
    const ends = this.#places.map((coordinates) => feature("Point", coordinates));
    this.#draw([...(line.length > 1 ? [feature("LineString", line)] : []), ...ends]);
    const metres = line.slice(1).reduce((sum, to, index) => sum + distance(line[index], to), 0);
    this.#say(metres, line.length);
  }
}

function feature(type, coordinates) {
  return { type: "Feature", properties: {}, geometry: { type, coordinates } };
}
