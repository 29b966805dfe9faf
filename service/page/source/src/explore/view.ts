/** Sampled shapes, modes as sliders, and two results beside each other. */

import { type Api, sentence } from '../api'
import { field, h, replace } from '../dom'
import { modelOptions } from '../models'
import { rewrite } from '../route'
import { Status } from '../status'
import { T } from '../text'
import type { ModelDescription } from '../types'
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
  private readonly wanted: string | null
  private readonly fail = (fault: unknown): void => this.status.fail(sentence(fault))

  constructor(
    private readonly api: Api,
    query: URLSearchParams,
  ) {
    this.modes = new Modes(api, this.fail)
    this.gallery = new Gallery(api, query, this.fail, () => this.remember())
    this.compare = new Compare(api, this.fail)
    this.wanted = query.get('model')
    this.model.addEventListener('change', () => void this.choose())
    const head = h('div', { class: 'row explore-head' }, h('h1', {}, T.explore.title), field(T.request.model, this.model))
    this.element = h('div', { class: 'explore' }, head, this.status.element, this.modes.element, this.gallery.element, this.compare.element)
  }

  async start(): Promise<void> {
    try {
      const models = await this.api.models()
      replace(this.model, ...modelOptions(models, this.wanted))
      await this.choose()
    } catch (fault) {
      this.status.fail(sentence(fault))
    }
  }

  /** Called whenever the view is turned to: other views may have made results meanwhile. */
  refresh(): void {
    this.compare.refresh()
    this.remember()
  }

  private async choose(): Promise<void> {
    try {
      const model: ModelDescription = await this.api.model(this.model.value)
      this.remember()
      this.status.say('')
      await this.modes.show(model).catch(this.fail)
      await this.gallery.show(model)
    } catch (fault) {
      this.status.fail(sentence(fault))
    }
  }

  /** The address says all that is needed to see the same again. */
  private remember(): void {
    if (location.hash.startsWith('#/explore') && this.model.value) {
      rewrite(`explore?${new URLSearchParams({ model: this.model.value, ...this.gallery.query() })}`)
    }
  }
}
