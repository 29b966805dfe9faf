/** Two results beside each other, each coloured by how far it lies outside (or inside) the other. */

import { type Api, isAbort, resultPath, sentence } from '../api'
import { legend, scaleAroundZero } from '../colour'
import { button, field, h, option, replace, unique } from '../dom'
import { type Surface, readMz3 } from '../mesh'
import { type Known, keep, knownResults } from '../results'
import { decoded } from '../route'
import { Status } from '../status'
import { T } from '../text'
import { PLAIN_LOOK, SurfaceView } from '../viewer'

export class Compare {
  readonly element = h('section', { class: 'card compare' })
  private readonly first = choice()
  private readonly second = choice()
  private readonly views = [new SurfaceView(T.compare.first), new SurfaceView(T.compare.second)] as const
  private readonly pair = h('div', { class: 'pair', hidden: true })
  private readonly legendPlace = h('div', { class: 'legend-place still' })
  private readonly status = new Status()
  private linked = false
  private readonly offered = new Set<string>()
  private working = new AbortController()

  constructor(private readonly api: Api) {
    this.status.element.classList.add('finding')
    const run = button(T.compare.run, () => void this.run(), { class: 'primary' })
    const controls = h('div', { class: 'row' }, field(T.compare.first, this.first.element), field(T.compare.second, this.second.element), run)
    replace(this.pair, ...this.views.map((view, n) => h('figure', {}, view.element, h('figcaption', {}, n === 0 ? T.compare.first : T.compare.second))))
    replace(this.element, h('h2', {}, T.compare.title), h('p', { class: 'hint' }, T.compare.how), controls, this.status.element, this.legendPlace, this.pair)
    this.refresh()
  }

  refresh(): void {
    const known = knownResults()
    for (const one of [this.first, this.second]) {
      replace(one.list, ...known.map((result) => option(result.id, result.label)))
    }
    this.offer(this.first.element, this.second.element, known)
    this.offer(this.second.element, this.first.element, known)
  }

  /** The latest result that the other place does not hold; what was offered before and is gone is taken back. */
  private offer(place: HTMLInputElement, other: HTMLInputElement, known: Known[]): void {
    if (this.offered.has(place.value) && !known.some(({ id }) => id === place.value)) place.value = ''
    if (place.value) return
    place.value = known.find(({ id }) => id !== identifier(other.value))?.id ?? ''
    this.offered.add(place.value)
  }

  private async run(): Promise<void> {
    const [a, b] = [identifier(this.first.element.value), identifier(this.second.element.value)]
    this.working.abort()
    this.working = new AbortController()
    if (!a || !b) this.fail(T.compare.needTwo)
    else if (a === b) this.fail(T.compare.needOther)
    else await this.measure(a, b, this.working.signal)
  }

  private async measure(a: string, b: string, signal: AbortSignal): Promise<void> {
    for (const id of [a, b]) keep(id)
    try {
      this.status.say(T.compare.working)
      const surfaces = await Promise.all([this.fetch(a, b, signal), this.fetch(b, a, signal)])
      signal.throwIfAborted()
      await this.show(surfaces, signal)
    } catch (fault) {
      if (!isAbort(fault)) this.fail(sentence(fault))
    }
  }

  /** Told below the button, and brought into sight; surfaces of another comparison are shown no longer. */
  private fail(text: string): void {
    this.pair.hidden = true
    replace(this.legendPlace)
    this.status.fail(text)
    this.status.element.scrollIntoView({ block: 'nearest' })
  }

  private async show(surfaces: [Surface, Surface], signal: AbortSignal): Promise<void> {
    const both = new Float32Array(surfaces.flatMap((surface) => [...surface.scalars!]))
    const scale = scaleAroundZero(both)
    this.pair.hidden = false
    for (const n of [0, 1] as const) await this.views[n].show(surfaces[n], { ...PLAIN_LOOK, scale })
    signal.throwIfAborted()
    if (!this.linked) this.views[0].link(this.views[1])
    this.linked = true
    replace(this.legendPlace, legend(scale, T.compare.legend, 'mm'))
    const mean = both.reduce((sum, value) => sum + Math.abs(value), 0) / both.length
    this.status.say(T.compare.finding(mean, both.reduce((a, b) => Math.max(a, Math.abs(b)), 0)))
  }

  private async fetch(id: string, other: string, signal: AbortSignal): Promise<Surface> {
    return readMz3(await this.api.bytes(resultPath(id, `/comparison?other=${encodeURIComponent(other)}&format=mz3&space=RAS`), signal))
  }
}

function choice(): { element: HTMLInputElement; list: HTMLDataListElement } {
  const list = h('datalist', { id: unique('known') })
  const element = h('input', { type: 'text', list: list.id, placeholder: T.compare.placeholder, spellcheck: 'false' })
  document.body.append(list)
  return { element, list }
}

/** The identifier in a link or on its own. */
function identifier(text: string): string {
  return decoded(text.trim().replace(/^.*\/result\//, ''))
}
