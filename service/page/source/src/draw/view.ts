/** Draw contours on three planes; the surface follows each time the pen is lifted. */

import { type Api, formOf, isAbort, resultPath, sentence } from '../api'
import { scaleFromZero } from '../colour'
import { button, field, h, mark, replace } from '../dom'
import { PLANES, planeName } from '../grid'
import { LookControls, slider } from '../look'
import { readMz3 } from '../mesh'
import { modelOptions } from '../models'
import { readNifti, writeNifti } from '../nifti'
import { Pane } from '../pane'
import { dismiss, remember } from '../results'
import { type Placed, placed } from '../section'
import { Status } from '../status'
import { T } from '../text'
import type { Grid, Plane, Summary } from '../types'
import { SurfaceView } from '../viewer'
import { type Backdrop, backdropOf, drawOver, emptyGrid, paintOf } from './canvas'
import { Drawing } from './drawing'
import { Pen, type Tool } from './pen'
import { type Suggestion, nextPlane } from './suggestion'

const FEWEST_PLANES = 2

export class DrawView {
  readonly element: HTMLElement
  private readonly status = new Status()
  private readonly surface = new SurfaceView(T.result.surface)
  private readonly look = new LookControls(this.surface)
  private readonly model = h('select')
  private readonly panes = h('div', { class: 'panes' })
  private readonly told = h('div', { class: 'told' })
  private readonly undo = button(T.draw.undo, () => this.step('undo'), { disabled: true })
  private readonly redo = button(T.draw.redo, () => this.step('redo'), { disabled: true })
  private readonly tool: Tool = { kind: 'polygon', erase: false, radiusMm: 2 }
  private drawing: Drawing | null = null
  private backdrop: Backdrop | null = null
  private canvases: Pane[] = []
  private next: Suggestion | null = null
  private placed: Placed | null = null
  private working = new AbortController()
  private shown: string | null = null

  constructor(private readonly api: Api) {
    this.model.addEventListener('change', () => void this.begin(null))
    const stage = h('div', { class: 'stage' }, this.surface.element, this.look.legend)
    this.look.element.hidden = true
    const side = h('aside', { class: 'side' }, h('h1', {}, T.draw.title), h('p', {}, T.draw.how), this.setup(), this.tools(), this.status.element, this.told)
    const solid = h('div', { class: 'solid' }, stage, this.look.element)
    this.element = h('div', { class: 'split' }, side, h('div', { class: 'main drawing' }, this.panes, solid))
    this.element.addEventListener('keydown', (event) => this.key(event))
  }

  async start(): Promise<void> {
    try {
      const models = await this.api.models()
      replace(this.model, ...modelOptions(models))
      await this.begin(null)
    } catch (fault) {
      this.status.fail(sentence(fault))
    }
  }

  /** A new drawing on an image's grid, or on an empty one that fits the model. */
  private async begin(image: File | null): Promise<void> {
    try {
      const volume = image && readNifti(await image.arrayBuffer())
      const grid: Grid = volume ?? emptyGrid((await this.api.model(this.model.value)).half_extent_mm)
      this.backdrop = volume && backdropOf(volume.values)
      this.setDrawing(new Drawing({ shape: grid.shape, affine: grid.affine }))
      this.status.say(image ? T.draw.onImage(image.name) : T.draw.onEmpty)
    } catch (fault) {
      this.status.fail(sentence(fault))
    }
  }

  private setDrawing(drawing: Drawing): void {
    this.working.abort()
    this.drawing = drawing
    this.canvases = PLANES.map((name) => this.pane(name, drawing))
    replace(this.panes, ...this.canvases.map((pane) => pane.element))
    this.clearSurface()
    this.tellSteps()
  }

  private clearSurface(): void {
    this.next = this.placed = null
    this.look.element.hidden = true
    void this.surface.show(null, this.look.begin(null, false))
    replace(this.told)
    for (const pane of this.canvases) pane.draw()
  }

  private pane(name: (typeof PLANES)[number], drawing: Drawing): Pane {
    const pane = new Pane(name, drawing.grid, { tabindex: 0, role: 'application', 'aria-label': `${T.plane[name]}. ${T.draw.keys}` })
    const pen = new Pen(pane, () => this.tool, (where, voxels, value) => this.commit(where, voxels, value))
    pane.show(
      paintOf(drawing, this.backdrop, () => pen, () => this.tool),
      (context) => drawOver(context, pane, pen, drawing, { next: this.next?.plane ?? null, surface: this.placed }),
    )
    return pane
  }

  private commit(pane: Pane, voxels: number[], value: 0 | 1): void {
    if (!this.drawing?.apply(pane.layout.axis, pane.slice, voxels, value)) return
    this.tellSteps()
    void this.update()
  }

  private step(way: 'undo' | 'redo'): void {
    this.drawing?.[way]()
    this.tellSteps()
    void this.update()
  }

  private tellSteps(): void {
    this.undo.disabled = !this.drawing?.canUndo
    this.redo.disabled = !this.drawing?.canRedo
    for (const pane of this.canvases) pane.draw()
  }

  /** Send what is drawn now; what was sent before and is not answered yet is given up. */
  private async update(): Promise<void> {
    const drawing = this.drawing!
    this.working.abort()
    this.working = new AbortController()
    const { signal } = this.working
    const planes = drawing.annotated
    if (planes.length < FEWEST_PLANES || !drawing.labels.some((label) => label > 0)) {
      this.clearSurface()
      this.status.say(planes.length === 0 ? T.draw.onEmpty : T.draw.oneMore)
      return
    }
    const began = performance.now()
    this.status.say(T.draw.working(planes.length))
    try {
      const mask = new File([writeNifti(drawing.grid, drawing.labels)], 'drawing.nii')
      const form = formOf([mask], { model: this.model.value }, planes)
      const summary = await this.api.reconstruct(form, signal)
      await this.showSurface(summary, signal)
      mark(this.element, performance.now() - began)
      this.status.say(T.draw.done(planes.length, (performance.now() - began) / 1000))
      this.keepOnly(summary)
      this.suggest(await nextPlane(this.api, summary.id, signal))
    } catch (fault) {
      if (!isAbort(fault)) this.status.fail(sentence(fault))
    }
  }

  private async showSurface(summary: Summary, signal: AbortSignal): Promise<void> {
    const surface = readMz3(await this.api.bytes(resultPath(summary.id, '/mesh?format=mz3&space=RAS'), signal))
    const scale = surface.scalars && scaleFromZero(surface.scalars)
    const look = this.look.begin(scale && { name: T.figures.sdShort, label: T.figures.sdLegend, unit: 'mm', scale }, false)
    await this.surface.show(surface, look)
    this.placed = placed(surface, this.drawing!.grid)
    for (const pane of this.canvases) pane.draw()
    this.look.element.hidden = false
    replace(this.told, ...this.findings(summary))
  }

  /** Only the latest result of a drawing is worth keeping. */
  private keepOnly(summary: Summary): void {
    if (this.shown) {
      dismiss(this.shown)
      this.api.forget(this.shown).catch(() => undefined)
    }
    this.shown = summary.id
    remember({ id: summary.id, label: T.draw.label(summary.model.name, new Date(summary.created)) })
  }

  private findings(summary: Summary): HTMLElement[] {
    const link = h('a', { href: `#/result/${summary.id}` }, T.draw.open)
    return [
      h('p', { class: 'finding' }, T.draw.finding(summary)),
      ...summary.warnings.map((text) => h('p', { class: 'warning' }, text)),
      h('p', {}, link),
    ]
  }

  private suggest(next: Suggestion | null): void {
    this.next = next
    for (const pane of this.canvases) pane.draw()
    if (!next || !this.drawing) return
    const name = planeName(this.drawing.grid, next.plane.axis)
    const go = button(T.draw.goTo(T.plane[name], next.plane.index + 1), () => this.goTo(next.plane), { class: 'suggested' })
    this.told.prepend(h('div', { class: 'suggestion' }, h('p', {}, T.draw.suggested(next.gain)), go))
  }

  private goTo(plane: Plane): void {
    const pane = this.canvases.find((found) => found.layout.axis === plane.axis)
    pane?.goTo(plane.index)
    pane?.canvas.focus()
  }

  private setup(): HTMLElement {
    const image = h('input', { type: 'file', accept: '.nii,.nii.gz,.gz' })
    image.addEventListener('change', () => void this.begin(image.files?.[0] ?? null))
    const empty = (): void => {
      image.value = ''
      void this.begin(null)
    }
    return h('div', { class: 'request' }, field(T.request.model, this.model), field(T.draw.image, image, T.draw.imageHint), button(T.draw.clear, empty))
  }

  private tools(): HTMLElement {
    const kinds = (['polygon', 'brush'] as const).map((kind) => this.toolChoice(kind))
    const erase = h('input', { type: 'checkbox' })
    erase.addEventListener('change', () => (this.tool.erase = erase.checked))
    erase.dataset['tool'] = 'erase'
    const size = slider(0.5, 8, 2, (value) => (this.tool.radiusMm = value), 0.5)
    return h(
      'fieldset',
      { class: 'tools' },
      h('legend', {}, T.draw.tools),
      h('div', { class: 'row' }, ...kinds),
      h('label', { class: 'check' }, erase, T.draw.erase),
      field(T.draw.radius, size),
      h('div', { class: 'row' }, this.undo, this.redo),
    )
  }

  private toolChoice(kind: Tool['kind']): HTMLElement {
    const radio = h('input', { type: 'radio', name: 'tool', value: kind, checked: kind === this.tool.kind })
    radio.addEventListener('change', () => (this.tool.kind = kind))
    return h('label', { class: 'check' }, radio, T.draw.kinds[kind])
  }

  private key(event: KeyboardEvent): void {
    const typing = event.target instanceof HTMLInputElement && event.target.type === 'text'
    if (typing || !(event.ctrlKey || event.metaKey)) return
    if (event.key.toLowerCase() === 'z') this.step(event.shiftKey ? 'redo' : 'undo')
    else if (event.key.toLowerCase() === 'y') this.step('redo')
    else return
    event.preventDefault()
  }
}
