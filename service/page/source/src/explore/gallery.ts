/** Synthetic shapes by their seeds: the same address shows the same shapes. */

import { type Api, isAbort, sentence } from '../api'
import { button, field, h, replace } from '../dom'
import { frame, readMz3 } from '../mesh'
import { moveTo, slider, sliderField } from '../slider'
import { Status } from '../status'
import { T } from '../text'
import type { ModelDescription } from '../types'
import { PLAIN_LOOK, SurfaceView } from '../viewer'

const COUNT = 8
/** Requests under way at once; the service has other guests. */
const LANES = 2
const LARGEST_SEED = 2 ** 31

export class Gallery {
  readonly element = h('section', { class: 'card gallery' })
  private readonly seed = h('input', { type: 'number', min: 0, max: LARGEST_SEED, step: 1 })
  private readonly temperature: HTMLInputElement
  private readonly grid = h('ul', { class: 'shapes' })
  private readonly painter = new SurfaceView(T.gallery.painter, { cube: false, size: 1.3 })
  private readonly status = new Status()
  private model: ModelDescription | null = null
  private working = new AbortController()

  constructor(
    private readonly api: Api,
    query: URLSearchParams,
    private readonly changed: () => void,
  ) {
    this.status.element.classList.add('hint')
    this.seed.value = query.get('seed') ?? '0'
    this.temperature = slider(0.2, 2, Number(query.get('temperature') ?? 1), () => undefined, 0.1)
    for (const control of [this.seed, this.temperature]) control.addEventListener('change', () => this.redraw())
    this.painter.element.classList.add('offscreen')
    this.painter.element.setAttribute('aria-hidden', 'true')
    this.painter.element.inert = true
    const controls = h('div', { class: 'row' }, field(T.gallery.seed, this.seed), sliderField(T.gallery.temperature, this.temperature, T.plainNumber), button(T.gallery.more, () => this.more()))
    replace(this.element, h('h2', {}, T.gallery.title), h('p', { class: 'hint' }, T.gallery.how), controls, this.grid, this.status.element, this.painter.element)
  }

  query(): Record<string, string> {
    return { seed: this.seed.value, temperature: this.temperature.value }
  }

  async show(model: ModelDescription): Promise<void> {
    this.model = model
    await this.draw()
  }

  /** Take seed and variety from an address; false where it asks for nothing else than what is shown. */
  take(query: URLSearchParams): boolean {
    const { seed, temperature } = { ...this.query(), ...Object.fromEntries(query) }
    const differs = seed !== this.seed.value || temperature !== this.temperature.value
    this.seed.value = seed!
    moveTo(this.temperature, temperature!)
    return differs
  }

  /** Begin again with what seed and variety say now. */
  redraw(): void {
    if (this.model) void this.draw()
  }

  private more(): void {
    this.seed.value = String((Number(this.seed.value) + COUNT) % LARGEST_SEED)
    this.redraw()
  }

  private async draw(): Promise<void> {
    this.working.abort()
    this.working = new AbortController()
    const { signal } = this.working
    this.changed()
    const first = Math.min(Math.max(Math.round(Number(this.seed.value) || 0), 0), LARGEST_SEED)
    const items = Array.from({ length: COUNT }, (_, n) => this.item(first + n))
    replace(this.grid, ...items.map(([item]) => item))
    const waiting = items.map(([, canvas], n) => [first + n, canvas] as const)
    this.status.say(T.gallery.drawing)
    const lane = async (): Promise<void> => {
      for (let next = waiting.shift(); next; next = waiting.shift()) await this.paint(next[0], next[1], signal)
    }
    try {
      await Promise.all(Array.from({ length: LANES }, lane))
      signal.throwIfAborted()
      this.status.say(T.gallery.done(COUNT))
    } catch (fault) {
      this.fail(fault)
    }
  }

  private fail(fault: unknown): void {
    if (!isAbort(fault)) this.status.fail(sentence(fault))
  }

  private item(seed: number): [HTMLElement, HTMLCanvasElement] {
    const canvas = h('canvas', { width: 240, height: 200, role: 'img', 'aria-label': T.gallery.shape(seed) })
    const save = (): void => {
      this.api.download(`${this.path(seed)}&format=stl`, `shape_${seed}.stl`).then(
        () => this.status.recover(),
        (fault: unknown) => this.fail(fault),
      )
    }
    const caption = h('div', { class: 'row' }, h('span', {}, T.gallery.seedOf(seed)), button(T.gallery.save, save, { class: 'quiet', 'aria-label': T.gallery.saveSeed(seed) }))
    return [h('li', {}, canvas, caption), canvas]
  }

  private async paint(seed: number, canvas: HTMLCanvasElement, signal: AbortSignal): Promise<void> {
    const surface = readMz3(await this.api.bytes(`${this.path(seed)}&format=mz3`, signal))
    if (signal.aborted) return
    await this.painter.paint(surface, PLAIN_LOOK, frame(this.model!.half_extent_mm), canvas)
    canvas.dataset['drawn'] = '1'
  }

  private path(seed: number): string {
    return `v1/models/${encodeURIComponent(this.model!.name)}/samples/${seed}?temperature=${this.temperature.value}`
  }
}
