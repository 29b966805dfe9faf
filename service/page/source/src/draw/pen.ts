/** Pointer and keys on a pane become contours and brush strokes. */

import { voxelAt, voxelNumber } from '../grid'
import type { Pane } from '../pane'
import { type Point, insideContour, underBrush } from './shapes'

export interface Tool {
  kind: 'polygon' | 'brush'
  erase: boolean
  radiusMm: number
}

/** Told of voxels that were drawn on the pane's slice once the pen is lifted. */
export type Committed = (pane: Pane, voxels: number[], value: 0 | 1) => void

const CLOSE_PIXELS = 10
const DRAG_PIXELS = 4
const KEY_STEPS: Record<string, Point> = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }

export class Pen {
  /** Corners of a contour that is not closed yet, and pixels under a brush that is not lifted yet. */
  contour: Point[] = []
  pending = new Set<number>()
  /** Where keys would draw; null until keys are used. */
  cursor: Point | null = null
  private down: { x: number; y: number; last: Point; dragged: boolean } | null = null

  constructor(
    readonly pane: Pane,
    private readonly tool: () => Tool,
    private readonly committed: Committed,
  ) {
    const { canvas } = pane
    canvas.addEventListener('pointerdown', (event) => this.press(event))
    canvas.addEventListener('pointermove', (event) => this.move(event))
    canvas.addEventListener('pointerup', (event) => this.lift(event))
    canvas.addEventListener('pointercancel', () => this.cancel())
    canvas.addEventListener('dblclick', () => this.close())
    canvas.addEventListener('keydown', (event) => this.key(event))
    canvas.addEventListener('blur', () => this.hideCursor())
    pane.element.addEventListener('slice', () => this.cancel())
  }

  cancel(): void {
    this.contour = []
    this.pending.clear()
    this.down = null
    this.pane.draw()
  }

  /** Whether there is a contour that is not closed yet. */
  get isOpen(): boolean {
    return this.contour.length > 0
  }

  /** Take back the last corner of an open contour; not while it is being dragged. */
  takeBack(): void {
    if (this.down) return
    this.contour.pop()
    this.pane.draw()
  }

  private press(event: PointerEvent): void {
    if (event.button !== 0) return
    this.pane.canvas.setPointerCapture(event.pointerId)
    this.cursor = null
    const at = this.pane.pixelAt(event)
    this.down = { x: event.clientX, y: event.clientY, last: at, dragged: false }
    if (this.tool().kind === 'brush') this.brush(at, at)
  }

  private move(event: PointerEvent): void {
    if (!this.down) return
    const far = Math.hypot(event.clientX - this.down.x, event.clientY - this.down.y) > DRAG_PIXELS
    if (far && !this.down.dragged && this.tool().kind === 'polygon') this.contour = [...this.contour, this.down.last]
    this.down.dragged ||= far
    const at = this.pane.pixelAt(event)
    if (this.tool().kind === 'brush') this.brush(this.down.last, at)
    else if (this.down.dragged) this.contour.push(at)
    this.down.last = at
    this.pane.draw()
  }

  private lift(event: PointerEvent): void {
    if (!this.down) return
    const { dragged } = this.down
    this.down = null
    if (this.tool().kind === 'brush') this.commitBrush()
    else if (dragged) this.close()
    else this.addCorner(this.pane.pixelAt(event))
  }

  /** A corner of the contour; at the first one it closes. */
  private addCorner(at: Point): void {
    const first = this.contour[0]
    const { scaleX, scaleY } = this.pane.view
    const near = first && Math.hypot((at[0] - first[0]) * scaleX, (at[1] - first[1]) * scaleY) < CLOSE_PIXELS
    if (near && this.contour.length > 2) this.close()
    else this.contour.push(at)
    this.pane.draw()
  }

  private close(): void {
    if (this.contour.length > 2) this.commit(this.voxels(insideContour(this.contour, ...this.pane.size)))
    this.cancel()
  }

  private brush(from: Point, to: Point): void {
    const { spacingAcross, spacingDown } = this.pane.layout
    const pixels = underBrush(from, to, this.tool().radiusMm, [spacingAcross, spacingDown], ...this.pane.size)
    for (const voxel of this.voxels(pixels)) this.pending.add(voxel)
    this.pane.draw()
  }

  private commitBrush(): void {
    this.commit([...this.pending])
    this.cancel()
  }

  private commit(voxels: number[]): void {
    if (voxels.length > 0) this.committed(this.pane, voxels, this.tool().erase ? 0 : 1)
  }

  private voxels(pixels: Point[]): number[] {
    const { grid, layout, slice } = this.pane
    return pixels.map(([x, y]) => voxelNumber(grid, voxelAt(grid, layout, slice, x, y)))
  }

  private key(event: KeyboardEvent): void {
    const step = KEY_STEPS[event.key]
    if (step) this.moveCursor(step, event.shiftKey ? 5 : 1)
    else if (event.key === ' ') this.drawAtCursor()
    else if (event.key === 'Enter') this.close()
    else if (event.key === 'Escape') this.cancel()
    else if (event.key === 'PageUp') this.pane.goTo(this.pane.slice + 1)
    else if (event.key === 'PageDown') this.pane.goTo(this.pane.slice - 1)
    else return
    event.preventDefault()
  }

  private moveCursor(step: Point, times: number): void {
    const [width, height] = this.pane.size
    const [x, y] = this.cursor ?? [Math.floor(width / 2) + 0.5, Math.floor(height / 2) + 0.5]
    const within = (value: number, size: number): number => Math.min(Math.max(value, 0.5), size - 0.5)
    this.cursor = [within(x + step[0] * times, width), within(y + step[1] * times, height)]
    this.pane.draw()
  }

  private drawAtCursor(): void {
    if (!this.cursor) this.moveCursor([0, 0], 1)
    const at = this.cursor!
    if (this.tool().kind === 'polygon') {
      this.addCorner(at)
      return
    }
    this.brush(at, at)
    this.commitBrush()
  }

  private hideCursor(): void {
    if (!this.cursor) return
    this.cursor = null
    this.pane.draw()
  }
}
