/** The annotated planes before anything is reconstructed: on the planes themselves, and in space. */

import { DRAWN } from '../colour'
import { drawnVoxels } from '../drawn'
import { h, option, replace } from '../dom'
import { layoutOf, planeName } from '../grid'
import type { Pane } from '../pane'
import { fileOf } from '../places'
import { Sections, middleOf } from '../sections'
import { T } from '../text'
import type { DrawnPlanes, Plane } from '../types'

const TICK = 'rgb(241 163 64 / 75%)'

export class Preview {
  readonly element = h('div', { class: 'preview' })
  private readonly sections = new Sections()

  show(drawn: DrawnPlanes, files: string[]): void {
    const choice = h('select', { 'aria-label': T.preview.stack })
    drawn.stacks.forEach((_, n) => choice.append(option(String(n), fileOf({ stacks: drawn.stacks, files }, n))))
    choice.addEventListener('change', () => this.showStack(drawn, Number(choice.value)))
    const head = h('header', { class: 'row' }, h('h2', {}, T.preview.title), drawn.stacks.length > 1 && choice)
    replace(this.element, head, h('p', {}, summary(drawn)), this.sections.element, h('p', { class: 'hint' }, T.preview.hint))
    this.showStack(drawn, 0)
  }

  private showStack(drawn: DrawnPlanes, stack: number): void {
    const grid = drawn.stacks[stack]!
    const voxels = drawnVoxels(drawn, stack)
    const planes = drawn.planes.filter((plane) => plane.stack === stack)
    const start = middleOf(grid, voxels).map((middle, axis) => nearest(planes.filter((plane) => plane.axis === axis), middle))
    const paint = (voxel: number) => (voxels.has(voxel) ? ([...DRAWN, 255] as [number, number, number, number]) : null)
    this.sections.show(grid, paint, (context, pane) => markPlanes(context, pane, drawn, stack), start)
  }
}

/** Lines where annotated planes of the other directions cross the pane. */
export function markPlanes(context: CanvasRenderingContext2D, pane: Pane, drawn: DrawnPlanes, stack: number): void {
  const { across, down, flipAcross, flipDown } = pane.layout
  const [width, height] = pane.size
  const { left, top, scaleX, scaleY } = pane.view
  context.strokeStyle = TICK
  context.setLineDash([4, 4])
  for (const plane of drawn.planes) {
    if (plane.stack !== stack || (plane.axis !== across && plane.axis !== down)) continue
    const place = (size: number, flip: boolean): number => (flip ? size - 1 - plane.index : plane.index) + 0.5
    context.beginPath()
    if (plane.axis === across) {
      const x = left + place(width, flipAcross) * scaleX
      context.moveTo(x, top)
      context.lineTo(x, top + height * scaleY)
    } else {
      const y = top + place(height, flipDown) * scaleY
      context.moveTo(left, y)
      context.lineTo(left + width * scaleX, y)
    }
    context.stroke()
  }
  context.setLineDash([])
}

/** Index of the plane that lies nearest to a place; the place itself where there is none. */
function nearest(planes: Plane[], place: number): number {
  const away = (index: number): number => Math.abs(index - place)
  const found = [...planes].sort((a, b) => away(a.index) - away(b.index))[0]
  return found ? found.index : place
}

function summary(drawn: DrawnPlanes): string {
  const counts = new Map<string, number>()
  for (const plane of drawn.planes) {
    const name = T.plane[planeName(drawn.stacks[plane.stack]!, plane.axis)]
    counts.set(name, (counts.get(name) ?? 0) + 1)
  }
  const grid = drawn.stacks[0]!
  const sizes = layoutOf(grid, 'axial')
  return T.preview.summary(
    drawn.planes.length,
    [...counts].map(([name, count]) => `${count} ${name.toLowerCase()}`).join(', '),
    grid.shape.join(' × '),
    Math.max(sizes.spacingAcross, sizes.spacingDown, layoutOf(grid, 'coronal').spacingDown),
  )
}
