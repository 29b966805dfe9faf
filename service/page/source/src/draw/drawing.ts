/** Contours on the planes of a grid: which voxels are drawn, which planes were looked at, and the way back. */

import { planeVoxels, voxelCount } from '../grid'
import type { Grid, Plane } from '../types'

interface Stroke {
  plane: Plane
  voxels: number[]
  value: 0 | 1
}

/** A plane that was looked at, and the voxels that were drawn on it (not those of planes that cross it). */
interface Looked {
  plane: Plane
  drawn: Set<number>
}

/** In a file: a voxel on no plane that was looked at. */
const NOT_LOOKED_AT = 255

export class Drawing {
  readonly labels: Uint8Array
  private looked = new Map<string, Looked>()
  private done: Stroke[] = []
  private undone: Stroke[] = []
  private saved: Stroke | undefined

  constructor(readonly grid: Grid) {
    this.labels = new Uint8Array(voxelCount(grid))
  }

  /** Planes that were looked at, in order. */
  get annotated(): Plane[] {
    return [...this.looked.values()].map((one) => one.plane).sort((a, b) => a.axis - b.axis || a.index - b.index)
  }

  get canUndo(): boolean {
    return this.done.length > 0
  }

  get canRedo(): boolean {
    return this.undone.length > 0
  }

  /** Whether a file holds the drawing as it is now. */
  get isSaved(): boolean {
    return this.done.at(-1) === this.saved
  }

  isAnnotated(axis: number, index: number): boolean {
    return this.looked.has(name({ stack: 0, axis, index }))
  }

  /** Set voxels of one plane; they become one step of the way back. False where nothing changes. */
  apply(axis: number, index: number, voxels: Iterable<number>, value: 0 | 1): boolean {
    const stroke: Stroke = { plane: { stack: 0, axis, index }, voxels: [...new Set(voxels)], value }
    const changes = stroke.voxels.some((voxel) => this.labels[voxel] !== value)
    if (!changes && (value === 0 || this.isAnnotated(axis, index))) return false
    this.put(stroke)
    this.done.push(stroke)
    this.undone = []
    return true
  }

  undo(): void {
    const stroke = this.done.pop()
    if (!stroke) return
    this.undone.push(stroke)
    this.labels.fill(0)
    this.looked.clear()
    for (const earlier of this.done) this.put(earlier)
  }

  redo(): void {
    const stroke = this.undone.pop()
    if (!stroke) return
    this.put(stroke)
    this.done.push(stroke)
  }

  /** What was undone does not come back. */
  settle(): void {
    this.undone = []
  }

  /** The labels as a file holds them: 255 on all planes that were not looked at. */
  save(): Uint8Array {
    this.saved = this.done.at(-1)
    const values = new Uint8Array(this.labels.length).fill(NOT_LOOKED_AT)
    for (const { axis, index } of this.annotated) {
      for (const voxel of planeVoxels(this.grid, axis, index)) values[voxel] = this.labels[voxel]!
    }
    return values
  }

  private put(stroke: Stroke): void {
    const here = this.looked.get(name(stroke.plane))
    for (const voxel of stroke.voxels) this.labels[voxel] = stroke.value
    if (stroke.value === 1) this.draw(stroke, here)
    else if (here) this.eraseOn(here, stroke.voxels)
    else this.eraseOnOthers(stroke.voxels)
  }

  private draw({ plane, voxels }: Stroke, here: Looked = { plane, drawn: new Set() }): void {
    this.looked.set(name(plane), here)
    for (const voxel of voxels) here.drawn.add(voxel)
  }

  /** A plane on which nothing is left no longer counts as looked at; planes that cross it get back what they held. */
  private eraseOn(here: Looked, voxels: number[]): void {
    for (const voxel of voxels) here.drawn.delete(voxel)
    if ([...here.drawn].some((voxel) => this.labels[voxel])) return
    this.looked.delete(name(here.plane))
    const on = new Set(planeVoxels(this.grid, here.plane.axis, here.plane.index))
    for (const other of this.looked.values()) {
      for (const voxel of other.drawn) if (on.has(voxel)) this.labels[voxel] = 1
    }
  }

  private eraseOnOthers(voxels: number[]): void {
    for (const other of this.looked.values()) for (const voxel of voxels) other.drawn.delete(voxel)
  }
}

function name(plane: Plane): string {
  return `${plane.axis}:${plane.index}`
}
