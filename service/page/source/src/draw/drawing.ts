/** Contours on the planes of a grid: which voxels are drawn, which planes were looked at, and the way back. */

import { voxelCount } from '../grid'
import type { Grid, Plane } from '../types'

interface Stroke {
  plane: Plane
  voxels: number[]
  before: number[]
  value: 0 | 1
  /** Whether the plane counted as looked at before this stroke. */
  seen: boolean
}

export class Drawing {
  labels: Uint8Array
  private planes = new Map<string, Plane>()
  private done: Stroke[] = []
  private undone: Stroke[] = []

  constructor(readonly grid: Grid) {
    this.labels = new Uint8Array(voxelCount(grid))
  }

  /** Planes on which something was drawn, in order. */
  get annotated(): Plane[] {
    return [...this.planes.values()].sort((a, b) => a.axis - b.axis || a.index - b.index)
  }

  get canUndo(): boolean {
    return this.done.length > 0
  }

  get canRedo(): boolean {
    return this.undone.length > 0
  }

  isAnnotated(axis: number, index: number): boolean {
    return this.planes.has(name({ stack: 0, axis, index }))
  }

  /** Set voxels of one plane; they become one step of the way back. False where nothing changes. */
  apply(axis: number, index: number, voxels: Iterable<number>, value: 0 | 1): boolean {
    const changed = [...new Set(voxels)].filter((voxel) => this.labels[voxel] !== value)
    if (changed.length === 0) return false
    const plane = { stack: 0, axis, index }
    const stroke: Stroke = { plane, voxels: changed, before: changed.map((v) => this.labels[v]!), value, seen: this.isAnnotated(axis, index) }
    this.redoStroke(stroke)
    this.done.push(stroke)
    this.undone = []
    return true
  }

  undo(): void {
    const stroke = this.done.pop()
    if (!stroke) return
    stroke.voxels.forEach((voxel, n) => (this.labels[voxel] = stroke.before[n]!))
    if (!stroke.seen) this.planes.delete(name(stroke.plane))
    this.undone.push(stroke)
  }

  redo(): void {
    const stroke = this.undone.pop()
    if (!stroke) return
    this.redoStroke(stroke)
    this.done.push(stroke)
  }

  private redoStroke(stroke: Stroke): void {
    for (const voxel of stroke.voxels) this.labels[voxel] = stroke.value
    this.planes.set(name(stroke.plane), stroke.plane)
  }
}

function name(plane: Plane): string {
  return `${plane.axis}:${plane.index}`
}
