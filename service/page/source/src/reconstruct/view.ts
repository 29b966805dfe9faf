/** From mask files to a surface. */

import { type Api, Refusal, formOf, isAbort, sentence } from '../api'
import { button, h, replace } from '../dom'
import { planeSurface } from '../drawn'
import { remember } from '../results'
import { rewrite } from '../route'
import { Status } from '../status'
import { T } from '../text'
import type { DrawnPlanes, Summary } from '../types'
import { PLAIN_LOOK, SurfaceView } from '../viewer'
import { Preview } from './preview'
import { RequestForm } from './request'
import { ResultPanel } from './result'

export class ReconstructView {
  readonly element: HTMLElement
  private readonly form: RequestForm
  private readonly status = new Status()
  private readonly surface = new SurfaceView(T.result.surface)
  private readonly preview = new Preview()
  private readonly result: ResultPanel
  private readonly send: HTMLButtonElement
  private readonly stage = h('div', { class: 'stage offscreen' })
  private readonly below = h('div', { class: 'below' })
  private readonly welcome: HTMLElement
  private drawn: DrawnPlanes | null = null
  private reading = new AbortController()
  private working = new AbortController()
  private shown: string | null = null
  private sending = false
  private planesRead: Promise<void> = Promise.resolve()

  constructor(private readonly api: Api) {
    this.form = new RequestForm(api, () => (this.planesRead = this.readPlanes()))
    this.result = new ResultPanel(api, this.surface)
    this.send = button(T.request.send, () => void this.reconstruct(), { class: 'primary', disabled: true })
    this.welcome = welcome(() => void this.runExample())
    const take = button(T.request.takeExample, () => void this.takeExample(), { class: 'example' })
    const side = h('aside', { class: 'side' }, h('h1', {}, T.request.title), take, this.form.element, this.send, this.status.element)
    replace(this.stage, this.surface.element, this.result.look.legend)
    this.result.look.element.hidden = true
    const main = h('div', { class: 'main' }, this.welcome, this.stage, this.result.look.element, this.below)
    this.element = h('div', { class: 'split' }, side, main)
  }

  async start(): Promise<void> {
    await this.guarded(() => this.form.loadModels())
    await this.surface.start()
  }

  /** A result that was made before, by its link. */
  async open(id: string): Promise<void> {
    if (this.shown === id) return
    this.working.abort()
    this.working = new AbortController()
    await this.guarded(async () => {
      const next = this.status.wait([T.steps.summary, T.steps.surface], () => this.working.abort())
      const summary = await this.api.summary(id)
      next(1)
      await this.showResult(summary, null)
    })
  }

  private async takeExample(): Promise<void> {
    await this.guarded(() => this.form.takeExample())
  }

  private async runExample(): Promise<void> {
    await this.guarded(async () => {
      await this.form.takeExample()
      await this.reconstruct()
    })
  }

  private async readPlanes(): Promise<void> {
    this.reading.abort()
    this.reading = new AbortController()
    const { signal } = this.reading
    this.drawn = null
    this.send.disabled = this.form.files.length === 0
    if (this.form.files.length === 0) return
    await this.guarded(async () => {
      if (!this.sending) this.status.say(T.steps.reading)
      const drawn = await this.api.planes(formOf(this.form.files, this.form.planeChoices()), signal)
      this.drawn = drawn
      if (!this.sending) await this.showPreview(drawn)
    })
  }

  private async showPreview(drawn: DrawnPlanes): Promise<void> {
    this.shown = null
    rewrite('')
    this.openStage()
    this.result.look.element.hidden = true
    replace(this.result.look.legend)
    this.preview.show(drawn)
    replace(this.below, this.preview.element)
    this.status.say(T.preview.ready(drawn.planes.length))
    await this.surface.show(null, PLAIN_LOOK, planeSurface(drawn))
  }

  private async reconstruct(): Promise<void> {
    this.working.abort()
    this.working = new AbortController()
    const { signal } = this.working
    const form = formOf(this.form.files, this.form.allChoices())
    const steps = [this.form.slow ? T.steps.fitSlow : T.steps.fit, T.steps.surface]
    const next = this.status.wait(steps, () => this.working.abort())
    this.send.disabled = this.sending = true
    await this.guarded(async () => {
      const [summary] = await Promise.all([this.api.reconstruct(form, signal), this.planesRead])
      next(1)
      remember({ id: summary.id, label: T.result.label(summary.model.name, new Date(summary.created)) })
      await this.showResult(summary, this.drawn)
      rewrite(`result/${summary.id}`)
    })
    this.send.disabled = this.sending = false
  }

  private async showResult(summary: Summary, drawn: DrawnPlanes | null): Promise<void> {
    this.openStage()
    await this.result.show(summary, drawn, this.working.signal)
    this.shown = summary.id
    this.result.look.element.hidden = false
    replace(this.below, this.result.element)
    this.status.say(T.result.ready)
    this.element.dispatchEvent(new CustomEvent('result', { detail: summary.id }))
  }

  private openStage(): void {
    this.welcome.hidden = true
    this.stage.classList.remove('offscreen')
  }

  private async guarded(work: () => Promise<void>): Promise<void> {
    try {
      await work()
    } catch (fault) {
      if (isAbort(fault)) this.status.say(T.cancelled)
      else if (fault instanceof Refusal && fault.status === 404 && this.shown === null) this.status.fail(T.link.gone)
      else this.status.fail(sentence(fault))
    }
  }
}

function welcome(run: () => void): HTMLElement {
  return h(
    'section',
    { class: 'welcome' },
    h('h2', {}, T.welcome.title),
    h('p', {}, T.welcome.text),
    button(T.welcome.run, run, { class: 'primary large' }),
    h('ol', {}, ...T.welcome.steps.map((step) => h('li', {}, step))),
    h('p', { class: 'hint' }, T.welcome.research),
  )
}
