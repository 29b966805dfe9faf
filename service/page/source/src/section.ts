/** Where a surface crosses the slice of a pane, as lines on its canvas. */

import { voxelOfWorld } from './grid'
import type { Surface } from './mesh'
import type { Pane } from './pane'
import type { Grid, Vec3 } from './types'

/** A surface in the voxel coordinates of a grid. */
export interface Placed {
  vertices: Float32Array
  faces: Uint32Array
}

export function placed(surface: Surface, grid: Grid): Placed {
  const toVoxel = voxelOfWorld(grid)
  const vertices = new Float32Array(surface.vertices.length)
  for (let n = 0; n < vertices.length; n += 3) vertices.set(toVoxel(vector(surface.vertices, n)), n)
  return { vertices, faces: surface.faces }
}

export function drawSection(context: CanvasRenderingContext2D, pane: Pane, surface: Placed, colour: string): void {
  context.strokeStyle = colour
  context.lineWidth = 2
  context.beginPath()
  for (let f = 0; f < surface.faces.length; f += 3) {
    const corners = [0, 1, 2].map((n) => vector(surface.vertices, 3 * surface.faces[f + n]!)) as [Vec3, Vec3, Vec3]
    const ends = crossing(corners, pane.layout.axis, pane.slice)
    if (ends.length < 2) continue
    context.moveTo(...onScreen(pane, ends[0]!))
    context.lineTo(...onScreen(pane, ends[1]!))
  }
  context.stroke()
  context.lineWidth = 1
}

/** Points where a triangle's edges cross a plane of voxels. */
function crossing(corners: [Vec3, Vec3, Vec3], axis: number, index: number): Vec3[] {
  const found: Vec3[] = []
  corners.forEach((a, n) => {
    const b = corners[(n + 1) % 3]!
    const [ha, hb] = [a[axis]! - index, b[axis]! - index]
    if (ha < 0 === hb < 0) return
    const share = ha / (ha - hb)
    found.push([0, 1, 2].map((k) => a[k]! * (1 - share) + b[k]! * share) as Vec3)
  })
  return found
}

function onScreen(pane: Pane, voxel: Vec3): [number, number] {
  const { across, down, flipAcross, flipDown } = pane.layout
  const [width, height] = pane.size
  const place = (value: number, size: number, flip: boolean): number => (flip ? size - 1 - value : value) + 0.5
  return [
    pane.view.left + place(voxel[across]!, width, flipAcross) * pane.view.scaleX,
    pane.view.top + place(voxel[down]!, height, flipDown) * pane.view.scaleY,
  ]
}

function vector(values: Float32Array, at: number): Vec3 {
  return [values[at]!, values[at + 1]!, values[at + 2]!]
}
