/** Annotated planes as thin flat surfaces, and as voxels by their numbers. */

import { spacing, toWorld, voxelNumber, voxelsOf } from './grid'
import type { Surface } from './mesh'
import type { DrawnPlanes, Grid, Vec3 } from './types'

/** Half the thickness of a plane's surface, as a share of its spacing. */
const HALF_THICKNESS = 0.04

/** Both faces of every drawn voxel's middle plane. */
export function planeSurface(drawn: DrawnPlanes): Surface {
  const vertices: number[] = []
  const faces: number[] = []
  for (const plane of drawn.planes) {
    const grid = drawn.stacks[plane.stack]!
    for (const index of voxelsOf(grid, plane)) {
      for (const side of [-1, 1]) addSquare(vertices, faces, grid, index, plane.axis, side)
    }
  }
  return { vertices: new Float32Array(vertices), faces: new Uint32Array(faces), scalars: null }
}

/** Numbers of the voxels of one stack that are drawn on its annotated planes. */
export function drawnVoxels(drawn: DrawnPlanes, stack: number): Set<number> {
  const grid = drawn.stacks[stack]!
  const mine = drawn.planes.filter((plane) => plane.stack === stack)
  return new Set(mine.flatMap((plane) => voxelsOf(grid, plane).map((index) => voxelNumber(grid, index))))
}

function addSquare(vertices: number[], faces: number[], grid: Grid, index: Vec3, axis: number, side: number): void {
  const [first, second] = [0, 1, 2].filter((other) => other !== axis) as [number, number]
  const begin = vertices.length / 3
  for (const [a, b] of [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]] as const) {
    const corner: Vec3 = [...index]
    corner[first]! += a
    corner[second]! += b
    corner[axis]! += side * HALF_THICKNESS * Math.min(1, 1 / spacing(grid)[axis]!)
    vertices.push(...toWorld(grid, corner))
  }
  const turned = side > 0 ? [0, 1, 2, 0, 2, 3] : [0, 2, 1, 0, 3, 2]
  faces.push(...turned.map((n) => begin + n))
}
