/** What goes on, for eyes and for screen readers: waiting with its time, a sentence, or what went wrong. */

import { button, h, replace } from './dom'
import { T } from './text'

export class Status {
  readonly element = h('div', { class: 'status' })
  private readonly said = h('p', { role: 'status' })
  private readonly wrong = h('p', { role: 'alert' })
  private readonly hindrance = h('p', { role: 'alert' })
  private readonly waiting = h('div', { class: 'waiting', hidden: true })
  private timer = 0

  constructor() {
    this.element.append(this.waiting, this.said, this.wrong, this.hindrance)
  }

  say(text: string): void {
    this.stop()
    this.said.textContent = text
    this.wrong.textContent = ''
  }

  fail(text: string): void {
    this.stop()
    this.said.textContent = ''
    this.wrong.textContent = text === this.hindrance.textContent ? '' : text
  }

  /** What went wrong is over; anything else that is said stays. */
  recover(): void {
    this.wrong.textContent = ''
  }

  /** What stands in the way, told until it is taken back with an empty text; whatever else goes on is left alone. */
  hinder(text: string): void {
    if (this.hindrance.textContent !== text) this.hindrance.textContent = text
  }

  /** Steps with a bar and the time so far; `cancel` stops the work. */
  wait(steps: readonly string[], cancel: () => void): (step: number) => void {
    this.say('')
    const began = performance.now()
    const bar = h('progress', { max: steps.length, 'aria-label': T.progress })
    const time = h('span', { class: 'time' })
    const told = h('span')
    const show = (step: number): void => {
      bar.value = step
      told.textContent = steps[step] ?? ''
      this.said.textContent = ''
    }
    const tick = (): void => {
      time.textContent = T.seconds((performance.now() - began) / 1000)
    }
    replace(this.waiting, bar, h('div', { class: 'row' }, told, time, button(T.cancel, cancel, { class: 'quiet' })))
    this.waiting.hidden = false
    this.timer = window.setInterval(tick, 100)
    tick()
    show(0)
    return show
  }

  private stop(): void {
    window.clearInterval(this.timer)
    this.waiting.hidden = true
  }
}
