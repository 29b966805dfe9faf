/** Annotated planes as thin flat surfaces, and as voxels by their numbers. */

import { rowsOf, spacing, toWorld, voxelNumber, voxelsOf } from './grid'
import type { Surface } from './mesh'
import type { DrawnPlanes, Grid, Row, Vec3 } from './types'

/** Half the thickness of a plane's surface, as a share of its spacing. */
const HALF_THICKNESS = 0.04

/** Both faces of every drawn row of voxels' middle plane: an object has far more voxels than rows. */
export function planeSurface(drawn: DrawnPlanes): Surface {
  const vertices: number[] = []
  const faces: number[] = []
  for (const plane of drawn.planes) {
    const grid = drawn.stacks[plane.stack]!
    const away = HALF_THICKNESS * Math.min(1, 1 / spacing(grid)[plane.axis]!)
    for (const row of rowsOf(grid, plane)) {
      for (const side of [-1, 1]) addStrip(vertices, faces, grid, row, plane.axis, side * away)
    }
  }
  return { vertices: new Float32Array(vertices), faces: new Uint32Array(faces), scalars: null }
}

/** Numbers of the voxels of one stack that are drawn on its annotated planes. */
export function drawnVoxels(drawn: DrawnPlanes, stack: number): Set<number> {
  const grid = drawn.stacks[stack]!
  const found = new Set<number>()
  for (const plane of drawn.planes) {
    if (plane.stack !== stack) continue
    for (const index of voxelsOf(grid, plane)) found.add(voxelNumber(grid, index))
  }
  return found
}

function addStrip(vertices: number[], faces: number[], grid: Grid, { from, along, length }: Row, axis: number, away: number): void {
  const across = 3 - axis - along
  const begin = vertices.length / 3
  for (const [a, b] of [[-0.5, -0.5], [0.5, -0.5], [0.5, length - 0.5], [-0.5, length - 0.5]] as const) {
    const corner: Vec3 = [...from]
    corner[across]! += a
    corner[along]! += b
    corner[axis]! += away
    vertices.push(...toWorld(grid, corner))
  }
  const turned = away > 0 ? [0, 1, 2, 0, 2, 3] : [0, 2, 1, 0, 3, 2]
  faces.push(...turned.map((n) => begin + n))
}
