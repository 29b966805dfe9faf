/** Elements in one call: attributes, properties, listeners and children. */

type Child = Node | string | null | undefined | false
type Attributes = Record<string, string | number | boolean | null | undefined | ((event: never) => void)>

export function h<K extends keyof HTMLElementTagNameMap>(
  name: K,
  attributes: Attributes = {},
  ...children: Child[]
): HTMLElementTagNameMap[K] {
  const element = document.createElement(name)
  for (const [key, value] of Object.entries(attributes)) assign(element, key, value)
  element.append(...present(children))
  return element
}

export function replace(element: Element, ...children: Child[]): void {
  element.replaceChildren(...present(children))
}

export function option(value: string, label: string, selected = false): HTMLOptionElement {
  return h('option', { value, selected }, label)
}

/** A labelled control; the label is what a screen reader says. */
export function field(label: string, control: HTMLElement, hint?: string): HTMLElement {
  const id = (control.id ||= unique('control'))
  const told = hint ? h('small', { id: `${id}-hint` }, hint) : null
  if (told) control.setAttribute('aria-describedby', told.id)
  return h('div', { class: 'field' }, h('label', { for: id }, label), control, told)
}

export function button(label: string, onclick: () => void, attributes: Attributes = {}): HTMLButtonElement {
  return h('button', { type: 'button', onclick, ...attributes }, label)
}

/** Put a file into the reader's folder of downloads. */
export function saveAs(file: Blob, name: string): void {
  const url = URL.createObjectURL(file)
  h('a', { href: url, download: name }).click()
  setTimeout(() => URL.revokeObjectURL(url), 10_000)
}

/** Say how long (ms) an answer took, and which one it was: for those who measure. */
export function mark(element: HTMLElement, duration: number): void {
  count += 1
  element.dataset['latency'] = `${Math.round(duration)} ${count}`
}

let count = 0
export function unique(prefix: string): string {
  count += 1
  return `${prefix}-${count}`
}

function present(children: Child[]): (Node | string)[] {
  return children.filter((child): child is Node | string => child !== null && child !== undefined && child !== false)
}

function assign(element: HTMLElement, key: string, value: Attributes[string]): void {
  if (value === null || value === undefined || value === false) return
  if (typeof value === 'function') element.addEventListener(key.replace(/^on/, ''), value as EventListener)
  else if (key === 'value' && element instanceof HTMLInputElement) element.value = String(value)
  else element.setAttribute(key, value === true ? '' : String(value))
}
