/** Planes that the service's warnings name, in the words of the page. */

import { planeName } from './grid'
import { T } from './text'
import type { Stack, Summary } from './types'

/** What was sent, as far as it is known: grids of the stacks, and names of the files. */
export interface Sent {
  stacks: Stack[] | null
  files: string[]
}

const PLANE = /mask\[(\d+)\] axis (\d) index (\d+)/g
const NUMBER = /\d+/

/** The warnings of a result, with each plane as the page shows it. */
export function warningsInWords(summary: Summary, sent: Sent): string[] {
  const several = new Set(summary.planes.map((plane) => plane.stack)).size > 1
  return summary.warnings.map((text) =>
    text.replace(PLANE, (_, stack: string, axis: string, index: string) => {
      const place = placeOf(sent, Number(stack), Number(axis), Number(index))
      return several ? T.place.ofFile(place, fileOf(sent, Number(stack))) : place
    }),
  )
}

function placeOf({ stacks }: Sent, stack: number, axis: number, index: number): string {
  const grid = stacks?.[stack]
  if (!grid) return T.place.onAxis(axis, index + 1)
  return T.place.onPlane(T.plane[planeName(grid, axis)], index + 1, grid.shape[axis]!)
}

/** The file that a stack was read from, as its sender named it. */
export function fileOf({ stacks, files }: Sent, stack: number): string {
  const part = stacks?.[stack]?.part
  const number = part ? Number(NUMBER.exec(part)?.[0] ?? stack) : stack
  return files[number] ?? T.place.file(number + 1)
}
