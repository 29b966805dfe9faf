/** Sampled shapes, modes as sliders, and two results beside each other. */

import { type Api, isAbort, sentence } from '../api'
import { field, h, replace } from '../dom'
import { loadedModels, modelOptions } from '../models'
import { rewrite } from '../route'
import { Status } from '../status'
import { T } from '../text'
import { Compare } from './compare'
import { Gallery } from './gallery'
import { Modes } from './modes'

export class ExploreView {
  readonly element: HTMLElement
  private readonly status = new Status()
  private readonly model = h('select')
  private readonly modes: Modes
  private readonly gallery: Gallery
  private readonly compare: Compare
  private wanted: string | null
  private choosing = new AbortController()
  private readonly fail = (fault: unknown): void => {
    if (!isAbort(fault)) this.status.fail(sentence(fault))
  }

  constructor(
    private readonly api: Api,
    query: URLSearchParams,
  ) {
    this.modes = new Modes(api)
    this.gallery = new Gallery(api, query, () => this.remember())
    this.compare = new Compare(api)
    this.wanted = query.get('model')
    this.model.addEventListener('change', () => void this.choose())
    const head = h('div', { class: 'row explore-head' }, h('h1', {}, T.explore.title), field(T.request.model, this.model))
    this.element = h('div', { class: 'explore' }, head, this.status.element, this.modes.element, this.gallery.element, this.compare.element)
  }

  async start(): Promise<void> {
    try {
      const models = await loadedModels(this.api, this.status)
      replace(this.model, ...modelOptions(models, this.wanted))
      await this.choose()
    } catch (fault) {
      this.fail(fault)
    }
  }

  /** Called whenever the view is turned to: the address may ask for another shape, other views may have made results. */
  refresh(query: URLSearchParams): void {
    this.compare.refresh()
    const differs = this.gallery.take(query)
    this.wanted = query.get('model') ?? this.wanted
    if (this.take(query.get('model'))) void this.choose()
    else if (differs) this.gallery.redraw()
    else this.remember()
  }

  /** Whether another model is chosen now. */
  private take(model: string | null): boolean {
    const known = [...this.model.options].some((one) => one.value === model)
    if (!model || !known || model === this.model.value) return false
    this.model.value = model
    return true
  }

  /** What was chosen before and has not arrived yet is given up. */
  private async choose(): Promise<void> {
    this.choosing.abort()
    this.choosing = new AbortController()
    const { signal } = this.choosing
    try {
      this.remember()
      const model = await this.api.model(this.model.value, signal)
      this.status.say('')
      await this.modes.show(model, signal).catch(this.fail)
      signal.throwIfAborted()
      await this.gallery.show(model)
    } catch (fault) {
      this.fail(fault)
    }
  }

  /** The address says all that is needed to see the same again. */
  private remember(): void {
    if (location.hash.startsWith('#/explore') && this.model.value) {
      rewrite(`explore?${new URLSearchParams({ model: this.model.value, ...this.gallery.query() })}`)
    }
  }
}
