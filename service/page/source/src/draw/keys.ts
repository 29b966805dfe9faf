/** Keys that go back and forth among the strokes, wherever the focus is. */

export type Way = 'undo' | 'redo'

/** Inputs in which these keys are the browser's own: they take typed text back. */
const TYPED = ['text', 'number', 'password', 'search', 'email', 'url', 'tel']

/** Tell of the keys as long as a view is shown. */
export function listenForSteps(view: HTMLElement, step: (way: Way) => void): void {
  document.addEventListener('keydown', (event) => {
    const way = wayOf(event)
    if (!way || view.hidden || isTyping(event.target)) return
    step(way)
    event.preventDefault()
  })
}

function wayOf(event: KeyboardEvent): Way | null {
  if (!(event.ctrlKey || event.metaKey) || event.altKey) return null
  const key = event.key.toLowerCase()
  if (key === 'z') return event.shiftKey ? 'redo' : 'undo'
  return key === 'y' ? 'redo' : null
}

function isTyping(target: EventTarget | null): boolean {
  return target instanceof HTMLTextAreaElement || (target instanceof HTMLInputElement && TYPED.includes(target.type))
}
