/* The force recording on its own clock: coarse as a whole at once, finer where it is looked at. */

import { getBytes, Store } from "./server.js";

export class ForceRecording {
  constructor(arrived) {
    this.coarse = true; // while the program has not read the run
    this.parts = new Store(async (key) => {
      const rows = new Float64Array(await getBytes(`api/force?points=4096${key}`));
      return { count: rows.length / 3, time: (k) => rows[3 * k], load: (k) => rows[3 * k + 1] };
    }, arrived, 40);
  }

  /** The load between two times of the force clock, in as many points as can be seen; null until it is there. */
  between(from, to) {
    const whole = this.parts.get("");
    if (!whole?.count || this.coarse) return whole;
    // stretches on a grid of powers of two, so that panning asks rarely
    const span = 2 ** Math.ceil(Math.log2(Math.max(1e-3, to - from))), first = Math.floor(from / span) * span;
    if (2 * span >= whole.time(whole.count - 1) - whole.time(0)) return whole;
    return this.parts.get(`&first_s=${first}&stop_s=${first + 2 * span}`) ?? whole;
  }
}
