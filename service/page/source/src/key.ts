/** Asks for the service's key. */

import { field, h } from './dom'
import { T } from './text'

export function askForKey(wrong: boolean): Promise<string> {
  const input = h('input', { type: 'password', required: true, autocomplete: 'off' })
  const form = h(
    'form',
    { method: 'dialog' },
    h('h2', { id: 'key-title' }, T.key.title),
    h('p', {}, wrong ? T.key.wrong : T.key.why),
    field(T.key.label, input),
    h('button', { type: 'submit', class: 'primary' }, T.key.use),
  )
  const dialog = h('dialog', { 'aria-labelledby': 'key-title' }, form)
  document.body.append(dialog)
  dialog.addEventListener('cancel', (event) => event.preventDefault())
  dialog.showModal()
  return new Promise((resolve) => {
    form.addEventListener('submit', (event) => {
      event.preventDefault()
      dialog.close()
      dialog.remove()
      resolve(input.value)
    })
  })
}
