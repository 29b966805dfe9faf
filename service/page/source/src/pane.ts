/** One plane of a grid on a canvas, with a slider to scroll through its slices. */

import type { Rgb } from './colour'
import { h } from './dom'
import { type Layout, type PlaneName, layoutOf, toWorld, voxelAt, voxelNumber } from './grid'
import { T } from './text'
import type { Grid } from './types'

/** Colour (RGBA) of a voxel by its number; null leaves it empty. */
export type Paint = (voxel: number) => [...Rgb, number] | null
/** Draws over the picture; `place` gives the screen's pixel of a pixel of the picture. */
export type Over = (context: CanvasRenderingContext2D, pane: Pane) => void

const WHEEL_PIXELS = 40

export class Pane {
  readonly element: HTMLElement
  readonly canvas: HTMLCanvasElement
  readonly slider: HTMLInputElement
  layout: Layout
  slice = 0
  /** Where the picture lies on the canvas, and how many screen pixels a picture pixel is. */
  view = { left: 0, top: 0, scaleX: 1, scaleY: 1 }
  private paint: Paint = () => null
  private over: Over = () => undefined
  private readonly place = h('output', { class: 'place' })
  private wheeled = 0

  constructor(
    readonly name: PlaneName,
    public grid: Grid,
    attributes: Record<string, string | number> = { role: 'img' },
    heading: 'h2' | 'h3' = 'h3',
  ) {
    this.layout = layoutOf(grid, name)
    this.canvas = h('canvas', { 'aria-label': T.plane[name], ...attributes })
    this.slider = h('input', { type: 'range', min: 0, max: 0, value: 0, 'aria-label': T.sliceOf(T.plane[name]) })
    this.slider.addEventListener('input', () => this.goTo(Number(this.slider.value)))
    this.canvas.addEventListener('wheel', (event) => this.scroll(event), { passive: false })
    const head = h('header', {}, h(heading, {}, T.plane[name]), this.place)
    this.element = h('section', { class: 'pane', 'data-plane': name }, head, this.canvas, this.slider)
    new ResizeObserver(() => this.draw()).observe(this.canvas)
    this.setGrid(grid)
  }

  setGrid(grid: Grid): void {
    this.grid = grid
    this.layout = layoutOf(grid, this.name)
    const last = grid.shape[this.layout.axis]! - 1
    this.slider.max = String(last)
    this.slice = Math.round(last / 2)
    this.draw()
  }

  show(paint: Paint, over: Over = () => undefined): void {
    this.paint = paint
    this.over = over
    this.draw()
  }

  goTo(slice: number): void {
    this.slice = Math.min(Math.max(slice, 0), Number(this.slider.max))
    this.draw()
    this.element.dispatchEvent(new CustomEvent('slice', { detail: this.slice }))
  }

  /** Pixel of the picture (may lie outside) under a pointer. */
  pixelAt(event: { clientX: number; clientY: number }): [number, number] {
    const box = this.canvas.getBoundingClientRect()
    const ratio = this.canvas.width / box.width
    const x = ((event.clientX - box.left) * ratio - this.view.left) / this.view.scaleX
    const y = ((event.clientY - box.top) * ratio - this.view.top) / this.view.scaleY
    return [x, y]
  }

  get size(): [number, number] {
    return [this.grid.shape[this.layout.across]!, this.grid.shape[this.layout.down]!]
  }

  draw(): void {
    this.slider.value = String(this.slice)
    this.slider.setAttribute('aria-valuetext', this.placeText())
    this.place.textContent = this.placeText()
    const { clientWidth, clientHeight } = this.canvas
    if (!clientWidth || !clientHeight) return
    const ratio = Math.min(devicePixelRatio || 1, 2)
    this.canvas.width = Math.round(clientWidth * ratio)
    this.canvas.height = Math.round(clientHeight * ratio)
    this.fit()
    const context = this.canvas.getContext('2d')!
    const [width, height] = this.size
    context.imageSmoothingEnabled = false
    context.drawImage(this.picture(), this.view.left, this.view.top, width * this.view.scaleX, height * this.view.scaleY)
    this.over(context, this)
    this.drawLetters(context, ratio)
  }

  private placeText(): string {
    const index = voxelAt(this.grid, this.layout, this.slice, 0, 0)
    const world = { axial: 2, coronal: 1, sagittal: 0 }[this.name]
    return T.sliceAt(this.slice + 1, Number(this.slider.max) + 1, toWorld(this.grid, index)[world]!)
  }

  private fit(): void {
    const [width, height] = this.size
    const { spacingAcross, spacingDown } = this.layout
    const scale = Math.min(this.canvas.width / (width * spacingAcross), this.canvas.height / (height * spacingDown))
    const [scaleX, scaleY] = [scale * spacingAcross, scale * spacingDown]
    this.view = {
      left: (this.canvas.width - width * scaleX) / 2,
      top: (this.canvas.height - height * scaleY) / 2,
      scaleX,
      scaleY,
    }
  }

  private picture(): OffscreenCanvas {
    const [width, height] = this.size
    const image = new ImageData(width, height)
    for (let y = 0; y < height; y += 1) {
      for (let x = 0; x < width; x += 1) {
        const colour = this.paint(voxelNumber(this.grid, voxelAt(this.grid, this.layout, this.slice, x, y)))
        if (colour) image.data.set(colour, 4 * (x + width * y))
      }
    }
    const canvas = new OffscreenCanvas(width, height)
    canvas.getContext('2d')!.putImageData(image, 0, 0)
    return canvas
  }

  private drawLetters(context: CanvasRenderingContext2D, ratio: number): void {
    const { width, height } = this.canvas
    const [left, right, top, bottom] = this.layout.letters
    const margin = 10 * ratio
    context.font = `${11 * ratio}px system-ui, sans-serif`
    context.fillStyle = '#9fb4bd'
    context.textAlign = 'center'
    context.textBaseline = 'middle'
    context.fillText(left, margin, height / 2)
    context.fillText(right, width - margin, height / 2)
    context.fillText(top, width / 2, margin)
    context.fillText(bottom, width / 2, height - margin)
  }

  private scroll(event: WheelEvent): void {
    event.preventDefault()
    this.wheeled += event.deltaY
    const steps = Math.trunc(this.wheeled / WHEEL_PIXELS)
    this.wheeled -= steps * WHEEL_PIXELS
    if (steps) this.goTo(this.slice + steps)
  }
}

/** A line around the voxels of a slice that belong to something. */
export function outline(context: CanvasRenderingContext2D, pane: Pane, belongs: (voxel: number) => boolean, colour: string): void {
  const { grid, layout, slice, view } = pane
  const [width, height] = pane.size
  const held = new Uint8Array(width * height)
  for (let n = 0; n < held.length; n += 1) {
    held[n] = belongs(voxelNumber(grid, voxelAt(grid, layout, slice, n % width, Math.floor(n / width)))) ? 1 : 0
  }
  const holds = (x: number, y: number): boolean => x >= 0 && y >= 0 && x < width && y < height && held[x + width * y] === 1
  context.strokeStyle = colour
  context.lineWidth = 2
  context.beginPath()
  for (let y = 0; y <= height; y += 1) {
    for (let x = 0; x <= width; x += 1) {
      const [px, py] = [view.left + x * view.scaleX, view.top + y * view.scaleY]
      const here = holds(x, y)
      if (here !== holds(x - 1, y)) segment(context, px, py, px, py + view.scaleY)
      if (here !== holds(x, y - 1)) segment(context, px, py, px + view.scaleX, py)
    }
  }
  context.stroke()
  context.lineWidth = 1
}

function segment(context: CanvasRenderingContext2D, x0: number, y0: number, x1: number, y1: number): void {
  context.moveTo(x0, y0)
  context.lineTo(x1, y1)
}
