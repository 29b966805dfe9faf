/** From mask files to a surface. */

import { type Api, Refusal, formOf, isAbort, sentence } from '../api'
import { button, h, replace } from '../dom'
import { planeSurface } from '../drawn'
import { keep, remember } from '../results'
import { resultPlace, rewrite } from '../route'
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
  private reading = new AbortController()
  private working = new AbortController()
  private shown: string | null = null
  private sending = false
  private lookingUp = false
  /** Whether other masks were chosen while something was sent, and their planes once they are read. */
  private stale = false
  private unseen: DrawnPlanes | null = null
  private planesRead: Promise<DrawnPlanes | null> = Promise.resolve(null)

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
    void this.guarded(() => this.form.loadModels(this.status))
    await this.surface.start()
  }

  /** Called whenever the view is turned to without a result: the address is that of what is shown. */
  refresh(): void {
    if (!this.element.hidden) rewrite(this.shown ? resultPlace(this.shown) : '')
  }

  /** A result that was made before, by its link. */
  async open(id: string): Promise<void> {
    keep(id)
    if (this.shown === id) {
      if (this.lookingUp) this.leaveLookingUp(T.result.ready)
      return
    }
    const [next, signal] = this.begin([T.steps.summary, T.steps.surface])
    this.endSending()
    this.lookingUp = true
    await this.guarded(async () => {
      const summary = await this.api.summary(id, signal).catch(toldAsGone)
      next(1)
      await this.showResult(summary, null, [], signal)
    })
    if (signal === this.working.signal) this.lookingUp = false
  }

  /** Something else is asked for than the result that is being looked up. */
  private leaveLookingUp(text: string): void {
    this.working.abort()
    this.lookingUp = false
    this.status.say(text)
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

  /** Which planes count as looked at; null where that is not known. */
  private async readPlanes(): Promise<DrawnPlanes | null> {
    this.reading.abort()
    this.reading = new AbortController()
    const { signal } = this.reading
    const { files } = this.form
    if (this.lookingUp) this.leaveLookingUp('')
    if (!this.sending) this.clear()
    this.stale = this.sending
    this.unseen = null
    if (files.length === 0) return null
    let drawn: DrawnPlanes | null = null
    const read = async (): Promise<void> => {
      if (!this.sending) this.status.say(T.steps.reading)
      drawn = await this.api.planes(formOf(files, this.form.planeChoices()), signal)
      if (this.sending) {
        this.unseen = drawn
        return
      }
      this.status.say(T.preview.ready(drawn.planes.length))
      await this.showPreview(drawn)
    }
    await this.guarded(read, () => !this.sending)
    return drawn
  }

  /** Nothing tells of files that are no longer chosen; a result stays until there is something else to show. */
  private clear(): void {
    this.status.say('')
    this.send.disabled = this.form.files.length === 0
    this.clearPreview()
  }

  private clearPreview(): void {
    if (this.shown) return
    replace(this.below)
    void this.surface.show(null, PLAIN_LOOK)
    if (this.form.files.length === 0) this.closeStage()
  }

  private async showPreview(drawn: DrawnPlanes): Promise<void> {
    this.shown = this.unseen = null
    this.stale = false
    this.refresh()
    this.openStage()
    this.result.look.element.hidden = true
    replace(this.result.look.legend)
    this.preview.show(drawn, this.form.files.map((file) => file.name))
    replace(this.below, this.preview.element)
    await this.surface.show(null, PLAIN_LOOK, planeSurface(drawn))
  }

  private async reconstruct(): Promise<void> {
    const form = formOf(this.form.files, this.form.allChoices())
    const files = this.form.files.map((file) => file.name)
    const [next, signal] = this.begin([this.form.slow ? T.steps.fitSlow : T.steps.fit, T.steps.surface])
    this.send.disabled = this.sending = true
    await this.guarded(async () => {
      const [summary, drawn] = await Promise.all([this.api.reconstruct(form, signal), this.planesRead])
      next(1)
      remember({ id: summary.id, label: T.result.label(summary.model.name, new Date(summary.created)) })
      await this.showResult(summary, drawn, files, signal)
    })
    if (signal !== this.working.signal) return
    this.endSending()
    if (this.unseen) await this.showPreview(this.unseen)
    else if (this.stale) this.clearPreview()
  }

  /** Give up what is under way, and tell the steps of something new, which can be cancelled. */
  private begin(steps: string[]): [(step: number) => void, AbortSignal] {
    this.working.abort()
    this.working = new AbortController()
    const cancel = (): void => {
      this.working.abort()
      this.status.say(T.cancelled)
    }
    this.lookingUp = false
    return [this.status.wait(steps, cancel), this.working.signal]
  }

  private endSending(): void {
    this.sending = false
    this.send.disabled = this.form.files.length === 0
  }

  private async showResult(summary: Summary, drawn: DrawnPlanes | null, files: string[], signal: AbortSignal): Promise<void> {
    this.openStage()
    await this.result.show(summary, drawn, files, signal)
    this.shown = summary.id
    this.unseen = null
    this.stale = false
    keep(summary.id)
    this.result.look.element.hidden = false
    replace(this.below, this.result.element)
    this.status.say(T.result.ready)
    this.refresh()
  }

  private openStage(): void {
    this.welcome.hidden = true
    this.stage.classList.remove('offscreen')
  }

  private closeStage(): void {
    this.welcome.hidden = false
    this.stage.classList.add('offscreen')
  }

  /** @param tells whether what goes wrong is still worth telling. */
  private async guarded(work: () => Promise<void>, tells: () => boolean = () => true): Promise<void> {
    try {
      await work()
    } catch (fault) {
      if (!isAbort(fault) && tells()) this.status.fail(sentence(fault))
    }
  }
}

function toldAsGone(fault: unknown): never {
  throw fault instanceof Refusal && fault.status === 404 ? new Refusal(T.link.gone, fault.status) : fault
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
