/** Draw contours on three planes; the surface follows each time the pen is lifted. */

import { gzipSync } from 'fflate'
import { type Api, formOf, isAbort, resultPath, sentence } from '../api'
import { scaleFromZero } from '../colour'
import { button, field, h, mark, replace, saveAs } from '../dom'
import { PLANES, planeName } from '../grid'
import { LookControls } from '../look'
import { readMz3 } from '../mesh'
import { loadedModels, modelOptions } from '../models'
import { readNifti, writeNifti } from '../nifti'
import { Pane } from '../pane'
import { warningsInWords } from '../places'
import { dismiss, isKept, keep, remember } from '../results'
import { resultPlace } from '../route'
import { type Placed, placed } from '../section'
import { Status } from '../status'
import { T } from '../text'
import type { Plane, Summary } from '../types'
import { SurfaceView } from '../viewer'
import { backdropOf, drawOver, emptyGrid, paintOf } from './canvas'
import { Drawing } from './drawing'
import { type Way, listenForSteps } from './keys'
import { Pen, type Tool } from './pen'
import { type Sheet, Sheets } from './sheets'
import { type Suggestion, nextPlane } from './suggestion'
import { toolChoices } from './tools'

const FEWEST_PLANES = 2
/** What a reader does to a link who wants to have what it leads to. */
const TAKING = ['click', 'auxclick', 'contextmenu', 'dragstart']

export class DrawView {
  readonly element: HTMLElement
  private readonly status = new Status()
  private readonly surface = new SurfaceView(T.result.surface)
  private readonly look = new LookControls(this.surface)
  private readonly model = h('select')
  private readonly image = h('input', { type: 'file', accept: '.nii,.nii.gz,.gz' })
  private readonly panes = h('div', { class: 'panes' })
  private readonly told = h('div', { class: 'told' })
  private readonly undo = button(T.draw.undo, () => this.step('undo'), { disabled: true })
  private readonly redo = button(T.draw.redo, () => this.step('redo'), { disabled: true })
  private readonly save = button(T.draw.save, () => this.download(), { disabled: true })
  private readonly tool: Tool = { kind: 'polygon', erase: false, radiusMm: 2 }
  private readonly sheets = new Sheets()
  private pens: Pen[] = []
  private next: Suggestion | null = null
  private placed: Placed | null = null
  private beginning = new AbortController()
  private working = new AbortController()
  private shown: string | null = null

  constructor(private readonly api: Api) {
    this.model.addEventListener('change', () => void this.changeModel())
    this.image.addEventListener('change', () => void this.begin(this.image.files?.[0] ?? null))
    const stage = h('div', { class: 'stage' }, this.surface.element, this.look.legend)
    this.look.element.hidden = true
    const tools = toolChoices(this.tool, this.undo, this.redo)
    const side = h('aside', { class: 'side' }, h('h1', {}, T.draw.title), h('p', {}, T.draw.how), this.setup(), tools, this.save, this.status.element, this.told)
    const solid = h('div', { class: 'solid' }, stage, this.look.element)
    this.element = h('div', { class: 'split' }, side, h('div', { class: 'main drawing' }, this.panes, solid))
    listenForSteps(this.element, (way) => this.step(way))
    window.addEventListener('beforeunload', (event) => {
      if (this.drawing?.isSaved === false) event.preventDefault()
    })
  }

  async start(): Promise<void> {
    try {
      replace(this.model, ...modelOptions(await loadedModels(this.api, this.status)))
      if (!this.sheets.current) await this.begin(null)
    } catch (fault) {
      this.status.fail(sentence(fault))
    }
  }

  private get drawing(): Drawing | null {
    return this.sheets.current?.drawing ?? null
  }

  private get canvases(): Pane[] {
    return this.pens.map((pen) => pen.pane)
  }

  /** A new drawing on an image's grid, or on an empty one that fits the model, unless it is no longer wanted then. */
  private async begin(image: File | null, wanted: () => boolean = () => true): Promise<void> {
    this.beginning.abort()
    this.beginning = new AbortController()
    const { signal } = this.beginning
    try {
      const sheet = await this.sheetOf(image, signal)
      signal.throwIfAborted()
      if (!wanted()) return
      this.sheets.begin(sheet)
      this.showSheet(sheet)
      this.status.say(this.hint())
    } catch (fault) {
      if (!isAbort(fault)) this.status.fail(sentence(fault))
    }
  }

  private async sheetOf(image: File | null, signal: AbortSignal): Promise<Sheet> {
    const volume = image && readNifti(await image.arrayBuffer())
    const { shape, affine } = volume ?? emptyGrid((await this.api.model(this.model.value, signal)).half_extent_mm)
    return { drawing: new Drawing({ shape, affine }), image, backdrop: volume && backdropOf(volume.values) }
  }

  /** What is drawn is fitted by the other model; where nothing is, there is a new grid that fits it. */
  private async changeModel(): Promise<void> {
    if (this.sheets.isBlank) await this.begin(null, () => this.sheets.isBlank)
    else {
      this.clearSurface()
      await this.update()
    }
  }

  private showSheet(sheet: Sheet): void {
    this.working.abort()
    const chosen = new DataTransfer()
    if (sheet.image) chosen.items.add(sheet.image)
    this.image.files = chosen.files
    this.pens = PLANES.map((name) => this.pen(name, sheet))
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

  private pen(name: (typeof PLANES)[number], { drawing, backdrop }: Sheet): Pen {
    const pane = new Pane(name, drawing.grid, { tabindex: 0, role: 'application', 'aria-label': `${T.plane[name]}. ${T.draw.keys}` }, 'h2')
    const pen = new Pen(pane, () => this.tool, (where, voxels, value) => this.commit(where, voxels, value))
    pane.show(
      paintOf(drawing, backdrop, () => pen, () => this.tool),
      (context) => drawOver(context, pane, pen, drawing, { next: this.next?.plane ?? null, surface: this.placed }),
    )
    return pen
  }

  private commit(pane: Pane, voxels: number[], value: 0 | 1): void {
    if (!this.sheets.apply(pane.layout.axis, pane.slice, voxels, value)) return
    this.tellSteps()
    void this.update()
  }

  /** An open contour loses its last corner; otherwise a stroke, or a new drawing, is taken back or done again. */
  private step(way: Way): void {
    const open = this.pens.filter((pen) => pen.isOpen)
    const pen = open.find((one) => one.pane.canvas === document.activeElement) ?? open[0]
    if (way === 'undo' && pen) pen.takeBack()
    else if (way === 'undo' ? this.sheets.canUndo : this.sheets.canRedo) this.turn(way)
  }

  private turn(way: Way): void {
    const before = this.sheets.current
    this.sheets[way]()
    const sheet = this.sheets.current!
    if (sheet !== before) this.showSheet(sheet)
    this.tellSteps()
    void this.update()
  }

  private tellSteps(): void {
    this.undo.disabled = !this.sheets.canUndo
    this.redo.disabled = !this.sheets.canRedo
    this.save.disabled = this.drawing?.annotated.length === 0
    for (const pane of this.canvases) pane.draw()
  }

  private download(): void {
    const drawing = this.drawing!
    saveAs(new Blob([gzipSync(writeNifti(drawing.grid, drawing.save())).slice()]), T.draw.file)
  }

  /** What to do while there is nothing to fit. */
  private hint(): string {
    const { drawing, image } = this.sheets.current!
    if (drawing.annotated.length > 0) return T.draw.oneMore
    return image ? T.draw.onImage(image.name) : T.draw.onEmpty
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
      this.status.say(this.hint())
      return
    }
    const began = performance.now()
    this.status.say(T.draw.working(planes.length))
    try {
      const mask = new File([writeNifti(drawing.grid, drawing.labels)], 'drawing.nii')
      const form = formOf([mask], { model: this.model.value }, planes)
      const summary = await this.api.reconstruct(form, signal)
      await this.showSurface(summary, drawing, signal)
      mark(this.element, performance.now() - began)
      this.status.say(T.draw.done(planes.length, (performance.now() - began) / 1000))
      this.keepOnly(summary)
      this.suggest(await nextPlane(this.api, summary.id, signal))
    } catch (fault) {
      if (!isAbort(fault)) this.status.fail(sentence(fault))
    }
  }

  private async showSurface(summary: Summary, drawing: Drawing, signal: AbortSignal): Promise<void> {
    const surface = readMz3(await this.api.bytes(resultPath(summary.id, '/mesh?format=mz3&space=RAS'), signal))
    const scale = surface.scalars && scaleFromZero(surface.scalars)
    const look = this.look.begin(scale && { name: T.figures.sdShort, label: T.figures.sdLegend, unit: 'mm', scale }, false)
    await this.surface.show(surface, look)
    signal.throwIfAborted()
    this.placed = placed(surface, drawing.grid)
    for (const pane of this.canvases) pane.draw()
    this.look.element.hidden = false
    replace(this.told, ...this.findings(summary, drawing))
  }

  /** Only the latest result of a drawing is worth keeping, and those that somebody asked for. */
  private keepOnly(summary: Summary): void {
    if (this.shown && !isKept(this.shown)) {
      dismiss(this.shown)
      this.api.forget(this.shown).catch(() => undefined)
    }
    this.shown = summary.id
    remember({ id: summary.id, label: T.draw.label(summary.model.name, new Date(summary.created)) })
  }

  private findings(summary: Summary, drawing: Drawing): HTMLElement[] {
    const link = h('a', { href: `#/${resultPlace(summary.id)}` }, T.draw.open)
    for (const event of TAKING) link.addEventListener(event, () => keep(summary.id))
    const sent = { stacks: [{ ...drawing.grid, part: 'mask[0]' }], files: [] }
    return [
      h('p', { class: 'finding' }, T.draw.finding(summary)),
      ...warningsInWords(summary, sent).map((text) => h('p', { class: 'warning' }, text)),
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
    const empty = button(T.draw.clear, () => void this.begin(null))
    return h('div', { class: 'request' }, field(T.request.model, this.model), field(T.draw.image, this.image, T.draw.imageHint), empty)
  }
}
