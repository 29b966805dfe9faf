/** The mean shape, moved along the model's leading modes by sliders while they are dragged. */

import { type Api, isAbort, sentence } from '../api'
import { type Scale, legend, scaleAroundZero } from '../colour'
import { button, h, mark, replace } from '../dom'
import { frame, readMz3 } from '../mesh'
import { moveTo, slider, valueOf } from '../slider'
import { Status } from '../status'
import { T } from '../text'
import type { Mode, ModelDescription } from '../types'
import { PLAIN_LOOK, SurfaceView } from '../viewer'

const SHOWN = 6
const FARTHEST_SD = 3
/** While a slider moves the grid is this much coarser than the model's; the full one follows. */
const COARSER = 2
const REST_MS = 250

export class Modes {
  readonly element = h('section', { class: 'card modes' })
  private readonly view = new SurfaceView(T.modes.surface, { size: 1.25 })
  private readonly sliders = h('div', { class: 'sliders' })
  private readonly legendPlace = h('div', { class: 'legend-place' })
  private readonly status = new Status()
  private coordinates = new Map<number, number>()
  private model: ModelDescription | null = null
  private working = new AbortController()
  private busy = false
  private wanted: number | null = null
  private rest = 0
  private scale: Scale = scaleAroundZero(new Float32Array([1]))

  constructor(private readonly api: Api) {
    this.status.element.classList.add('hint')
    const reset = button(T.modes.reset, () => void this.begin(), { class: 'quiet' })
    const side = h('div', {}, h('h2', {}, T.modes.title), h('p', { class: 'hint' }, T.modes.how), this.sliders, reset, this.status.element)
    replace(this.element, side, h('div', { class: 'stage' }, this.view.element, this.legendPlace))
  }

  async show(model: ModelDescription, signal: AbortSignal): Promise<void> {
    const modes = await this.api.modes(model.name, signal)
    signal.throwIfAborted()
    this.model = model
    this.scale = scaleAroundZero(new Float32Array([1]))
    this.sliders.replaceChildren(...modes.slice(0, SHOWN).map((mode) => this.slider(mode)))
    await this.begin()
  }

  private async begin(): Promise<void> {
    this.coordinates.clear()
    for (const input of this.sliders.querySelectorAll('input')) moveTo(input, '0')
    this.status.say('')
    await this.fetch(1)
  }

  private slider(mode: Mode): HTMLElement {
    const input = slider(-FARTHEST_SD, FARTHEST_SD, 0, (value) => this.move(mode.rank, value), 0.1)
    const id = (input.id = `mode-${mode.rank}`)
    return h('div', { class: 'mode' }, h('label', { for: id }, T.modes.mode(mode.rank, mode.variance_explained)), input, valueOf(input, T.modes.sd))
  }

  private move(rank: number, sd: number): void {
    this.coordinates.set(rank, sd)
    this.wanted = performance.now()
    if (!this.busy) void this.follow()
  }

  /** One request at a time, always for the newest place; a finer surface once the slider rests. */
  private async follow(): Promise<void> {
    this.busy = true
    window.clearTimeout(this.rest)
    this.working.abort()
    while (this.wanted !== null) {
      const moved = this.wanted
      this.wanted = null
      await this.fetch(COARSER)
      mark(this.element, performance.now() - moved)
    }
    this.busy = false
    this.rest = window.setTimeout(() => void this.fetch(1), REST_MS)
  }

  /** Colours keep their meaning while sliders move; the scale only ever grows. */
  private widen(distances: Float32Array): void {
    const wanted = scaleAroundZero(distances)
    if (wanted.high > this.scale.high) this.scale = wanted
  }

  private async fetch(coarser: number): Promise<void> {
    const model = this.model!
    this.working.abort()
    this.working = new AbortController()
    const { signal } = this.working
    const query = new URLSearchParams({ format: 'mz3', spacing_mm: String(model.resolution_mm * coarser) })
    for (const [rank, sd] of this.coordinates) if (sd !== 0) query.append('mode', `${rank}:${sd}`)
    try {
      const surface = readMz3(await this.api.bytes(`v1/models/${encodeURIComponent(model.name)}/shape?${query}`, signal))
      if (surface.scalars) this.widen(surface.scalars)
      replace(this.legendPlace, surface.scalars && legend(this.scale, T.modes.legend, 'mm'))
      await this.view.show(surface, { ...PLAIN_LOOK, scale: surface.scalars && this.scale }, null, frame(model.half_extent_mm))
      if (coarser === 1) this.status.say(this.coordinates.size > 0 ? T.modes.fine : '')
      else this.status.recover()
    } catch (fault) {
      if (!isAbort(fault)) this.status.fail(sentence(fault))
    }
  }
}
