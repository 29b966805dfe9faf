/** Voxel grids in the world: which voxel axes an anatomical plane has, and how it lies on the screen. */

import type { DrawnPlane, Grid, Row, Vec3 } from './types'

export type PlaneName = 'axial' | 'coronal' | 'sagittal'
export const PLANES: PlaneName[] = ['axial', 'coronal', 'sagittal']

/** A plane of a grid on the screen: radiological, that is, the patient's right on the left. */
export interface Layout {
  name: PlaneName
  /** Voxel axis that the plane is perpendicular to, and those that run across and down the screen. */
  axis: number
  across: number
  down: number
  /** Whether the voxel index falls along the screen's axis. */
  flipAcross: boolean
  flipDown: boolean
  spacingAcross: number
  spacingDown: number
  /** What stands at the left, right, top and bottom edge. */
  letters: [string, string, string, string]
}

/** World axis of each plane's normal, of across and of down. */
const WORLD: Record<PlaneName, Vec3> = { axial: [2, 0, 1], coronal: [1, 0, 2], sagittal: [0, 1, 2] }
const LETTERS: Record<PlaneName, [string, string, string, string]> = {
  axial: ['R', 'L', 'A', 'P'],
  coronal: ['R', 'L', 'S', 'I'],
  sagittal: ['A', 'P', 'S', 'I'],
}

export function layoutOf(grid: Grid, name: PlaneName): Layout {
  const voxelAxis = axesByWorld(grid)
  const [axis, across, down] = WORLD[name].map((world) => voxelAxis[world]!) as Vec3
  const along = (voxel: number, world: number): number => grid.affine[world]![voxel]!
  return {
    name,
    axis,
    across,
    down,
    flipAcross: along(across, WORLD[name][1]) > 0,
    flipDown: along(down, WORLD[name][2]) > 0,
    spacingAcross: spacing(grid)[across]!,
    spacingDown: spacing(grid)[down]!,
    letters: LETTERS[name],
  }
}

/** The plane's name of a voxel axis. */
export function planeName(grid: Grid, axis: number): PlaneName {
  return PLANES.find((name) => layoutOf(grid, name).axis === axis)!
}

export function spacing(grid: Grid): Vec3 {
  return [0, 1, 2].map((axis) => Math.hypot(...[0, 1, 2].map((row) => grid.affine[row]![axis]!))) as Vec3
}

export function toWorld(grid: Grid, index: Vec3): Vec3 {
  return [0, 1, 2].map((row) => {
    const [a, b, c, d] = grid.affine[row]! as [number, number, number, number]
    return a * index[0] + b * index[1] + c * index[2] + d
  }) as Vec3
}

/** World (mm) to voxel coordinates, by Cramer's rule. */
export function voxelOfWorld(grid: Grid): (world: Vec3) => Vec3 {
  const columns = [0, 1, 2].map((axis) => [0, 1, 2].map((row) => grid.affine[row]![axis]!) as Vec3) as [Vec3, Vec3, Vec3]
  const size = dot(columns[0], cross(columns[1], columns[2]))
  const rows = [0, 1, 2].map((n) => cross(columns[(n + 1) % 3]!, columns[(n + 2) % 3]!))
  return (world) => {
    const away = world.map((value, row) => value - grid.affine[row]![3]!) as Vec3
    return rows.map((row) => dot(row, away) / size) as Vec3
  }
}

function cross(a: Vec3, b: Vec3): Vec3 {
  return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

function dot(a: Vec3, b: Vec3): number {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/** Number of a voxel in a volume whose first axis runs fastest, as in NIfTI. */
export function voxelNumber(grid: Grid, index: Vec3): number {
  return index[0] + grid.shape[0] * (index[1] + grid.shape[1] * index[2])
}

export function voxelCount(grid: Grid): number {
  return grid.shape[0] * grid.shape[1] * grid.shape[2]
}

/** Numbers of all voxels of a plane. */
export function* planeVoxels(grid: Grid, axis: number, index: number): Generator<number> {
  const last = grid.shape.map((size, n) => (n === axis ? index : size - 1))
  const from = (n: number): number => (n === axis ? index : 0)
  for (let k = from(2); k <= last[2]!; k += 1) {
    for (let j = from(1); j <= last[1]!; j += 1) {
      for (let i = from(0); i <= last[0]!; i += 1) yield voxelNumber(grid, [i, j, k])
    }
  }
}

/** Voxel of a pixel of a plane's picture. */
export function voxelAt(grid: Grid, layout: Layout, slice: number, x: number, y: number): Vec3 {
  const index: Vec3 = [0, 0, 0]
  index[layout.axis] = slice
  index[layout.across] = layout.flipAcross ? grid.shape[layout.across]! - 1 - x : x
  index[layout.down] = layout.flipDown ? grid.shape[layout.down]! - 1 - y : y
  return index
}

/** What is drawn on a plane, row by row. */
export function* rowsOf(grid: Grid, plane: DrawnPlane): Generator<Row> {
  const [first, along] = [0, 1, 2].filter((axis) => axis !== plane.axis) as [number, number]
  const width = grid.shape[along]!
  for (const [start, count] of plane.runs) {
    for (let at = start, left = count; left > 0; ) {
      const length = Math.min(left, width - (at % width))
      const from: Vec3 = [0, 0, 0]
      from[plane.axis] = plane.index
      from[first] = Math.floor(at / width)
      from[along] = at % width
      yield { from, along, length }
      at += length
      left -= length
    }
  }
}

/** Voxels that are drawn on a plane. */
export function* voxelsOf(grid: Grid, plane: DrawnPlane): Generator<Vec3> {
  for (const { from, along, length } of rowsOf(grid, plane)) {
    for (let n = 0; n < length; n += 1) {
      const index: Vec3 = [...from]
      index[along]! += n
      yield index
    }
  }
}

/** For each world axis the voxel axis that runs along it most closely; each is taken once. */
function axesByWorld(grid: Grid): Vec3 {
  const size = spacing(grid)
  const pairs = [0, 1, 2].flatMap((world) =>
    [0, 1, 2].map((voxel) => ({ world, voxel, share: Math.abs(grid.affine[world]![voxel]!) / size[voxel]! })),
  )
  const found: Vec3 = [-1, -1, -1]
  for (const pair of pairs.sort((a, b) => b.share - a.share)) {
    if (found[pair.world] === -1 && !found.includes(pair.voxel)) found[pair.world] = pair.voxel
  }
  return found
}
