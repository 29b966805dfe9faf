/** What a drawing looks like on a pane: image, mask, contour, cursor, and the suggested plane. */

import { DRAWN } from '../colour'
import type { Pane, Paint } from '../pane'
import { type Placed, drawSection } from '../section'
import type { Grid, Plane } from '../types'
import type { Drawing } from './drawing'
import type { Pen, Tool } from './pen'

/** Grey values of an image, from 0 to 255. */
export interface Backdrop {
  grey: Uint8ClampedArray
}

const PEN = '#ffd166'
const SUGGESTED = '#7bd88f'
const SURFACE = '#f1a340'

export function backdropOf(values: Float32Array): Backdrop {
  const sorted = sample(values).sort()
  const [low, high] = [0.01, 0.99].map((share) => sorted[Math.floor(share * (sorted.length - 1))] ?? 0) as [number, number]
  const grey = new Uint8ClampedArray(values.length)
  for (let n = 0; n < values.length; n += 1) grey[n] = (255 * (values[n]! - low)) / (high - low || 1)
  return { grey }
}

/** Voxels drawn on planes that were looked at stand out from those that only cross the pane. */
export function paintOf(drawing: Drawing, backdrop: Backdrop | null, pen: () => Pen, tool: () => Tool): Paint {
  return (voxel) => {
    const pending = pen().pending.has(voxel)
    if (pending) return tool().erase ? [90, 60, 60, 255] : [255, 209, 102, 255]
    const grey = backdrop?.grey[voxel] ?? null
    if (drawing.labels[voxel]) return mixed(grey)
    return grey === null ? null : [grey, grey, grey, 255]
  }
}

/** What is known beside the drawing itself. */
export interface Beside {
  next: Plane | null
  surface: Placed | null
}

export function drawOver(context: CanvasRenderingContext2D, pane: Pane, pen: Pen, drawing: Drawing, beside: Beside): void {
  outline(context, pane, drawing)
  if (beside.surface) drawSection(context, pane, beside.surface, SURFACE)
  if (beside.next) suggested(context, pane, beside.next)
  contour(context, pane, pen)
  if (pen.cursor) cursor(context, pane, pen)
}

/** A frame around the slice: solid where it was drawn on. */
function outline(context: CanvasRenderingContext2D, pane: Pane, drawing: Drawing): void {
  const { left, top, scaleX, scaleY } = pane.view
  const [width, height] = pane.size
  const annotated = drawing.isAnnotated(pane.layout.axis, pane.slice)
  context.strokeStyle = annotated ? `rgb(${DRAWN.join(' ')})` : 'rgb(128 150 160 / 35%)'
  context.lineWidth = annotated ? 3 : 1
  context.strokeRect(left + 1, top + 1, width * scaleX - 2, height * scaleY - 2)
  context.lineWidth = 1
}

function suggested(context: CanvasRenderingContext2D, pane: Pane, next: Plane): void {
  const { axis, across, down, flipAcross, flipDown } = pane.layout
  const { left, top, scaleX, scaleY } = pane.view
  const [width, height] = pane.size
  context.strokeStyle = SUGGESTED
  context.lineWidth = 2
  context.setLineDash([6, 5])
  const along = (flip: boolean, size: number): number => (flip ? size - 1 - next.index : next.index) + 0.5
  context.beginPath()
  if (next.axis === axis && next.index === pane.slice) {
    context.rect(left + 2, top + 2, width * scaleX - 4, height * scaleY - 4)
  } else if (next.axis === across) {
    context.moveTo(left + along(flipAcross, width) * scaleX, top)
    context.lineTo(left + along(flipAcross, width) * scaleX, top + height * scaleY)
  } else if (next.axis === down) {
    context.moveTo(left, top + along(flipDown, height) * scaleY)
    context.lineTo(left + width * scaleX, top + along(flipDown, height) * scaleY)
  }
  context.stroke()
  context.setLineDash([])
  context.lineWidth = 1
}

function contour(context: CanvasRenderingContext2D, pane: Pane, pen: Pen): void {
  if (pen.contour.length === 0) return
  const { left, top, scaleX, scaleY } = pane.view
  context.strokeStyle = PEN
  context.fillStyle = PEN
  context.lineWidth = 2
  context.beginPath()
  for (const [x, y] of pen.contour) context.lineTo(left + x * scaleX, top + y * scaleY)
  context.stroke()
  const [x, y] = pen.contour[0]!
  context.beginPath()
  context.arc(left + x * scaleX, top + y * scaleY, 5, 0, 2 * Math.PI)
  context.fill()
  context.lineWidth = 1
}

function cursor(context: CanvasRenderingContext2D, pane: Pane, pen: Pen): void {
  const { left, top, scaleX, scaleY } = pane.view
  const [x, y] = pen.cursor!
  const [cx, cy] = [left + x * scaleX, top + y * scaleY]
  context.strokeStyle = PEN
  context.lineWidth = 2
  context.beginPath()
  context.moveTo(cx - 12, cy)
  context.lineTo(cx + 12, cy)
  context.moveTo(cx, cy - 12)
  context.lineTo(cx, cy + 12)
  context.stroke()
  context.lineWidth = 1
}

function mixed(grey: number | null): [number, number, number, number] {
  if (grey === null) return [...DRAWN, 255]
  return [0.45 * grey + 0.55 * DRAWN[0], 0.45 * grey + 0.55 * DRAWN[1], 0.45 * grey + 0.55 * DRAWN[2], 255]
}

function sample(values: Float32Array): Float32Array {
  const every = Math.max(Math.floor(values.length / 20_000), 1)
  return values.filter((value, n) => n % every === 0 && Number.isFinite(value))
}

/** An empty grid around a model's shapes, centred on the world's origin. */
export function emptyGrid(half: [number, number, number]): Grid {
  const size = half.map((value) => 2 * (value * 1.25 + 3))
  const step = Math.max(1, Math.ceil(Math.max(...size) / 128))
  const shape = size.map((value) => Math.ceil(value / step)) as [number, number, number]
  const affine = [0, 1, 2].map((axis) => {
    const row = [0, 0, 0, (-step * (shape[axis]! - 1)) / 2]
    row[axis] = step
    return row
  })
  return { shape, affine: [...affine, [0, 0, 0, 1]] }
}
