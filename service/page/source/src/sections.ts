/** Three planes of a grid beside each other; each scrolls by itself. */

import { h, replace } from './dom'
import { PLANES } from './grid'
import { type Over, Pane, type Paint } from './pane'
import type { Grid } from './types'

export class Sections {
  readonly element = h('div', { class: 'panes' })
  panes: Pane[] = []

  /** Slices that hold something are shown first: the middle of the numbered voxels. */
  show(grid: Grid, paint: Paint, over: Over = () => undefined, start: number[] | null = null): void {
    this.panes = PLANES.map((name) => new Pane(name, grid))
    replace(this.element, ...this.panes.map((pane) => pane.element))
    for (const pane of this.panes) {
      pane.show(paint, over)
      if (start) pane.goTo(start[pane.layout.axis]!)
    }
  }

  repaint(paint: Paint, over: Over = () => undefined): void {
    for (const pane of this.panes) pane.show(paint, over)
  }
}

/** Index of the middle of some voxels, by axis. */
export function middleOf(grid: Grid, voxels: Iterable<number>): number[] {
  const sums = [0, 0, 0, 0]
  for (const voxel of voxels) {
    sums[0]! += voxel % grid.shape[0]
    sums[1]! += Math.floor(voxel / grid.shape[0]) % grid.shape[1]
    sums[2]! += Math.floor(voxel / (grid.shape[0] * grid.shape[1]))
    sums[3]! += 1
  }
  return sums.slice(0, 3).map((sum, axis) => Math.round(sums[3] ? sum / sums[3]! : grid.shape[axis]! / 2))
}
