/** Light and dark: the system's choice, or the reader's own. */

import { T } from './text'
import { h, option } from './dom'

type Theme = 'system' | 'light' | 'dark'
const STORED = 'morphoflow-theme'
const listeners = new Set<() => void>()

/** Called now and whenever colours change. */
export function onTheme(listener: () => void): void {
  listeners.add(listener)
  listener()
}

export function startTheme(): void {
  apply(stored())
  matchMedia('(prefers-color-scheme: dark)').addEventListener('change', tell)
}

export function themeChoice(): HTMLElement {
  const choice = h('select', { 'aria-label': T.theme.label })
  for (const theme of ['system', 'light', 'dark'] as const) {
    choice.append(option(theme, T.theme[theme], theme === stored()))
  }
  choice.addEventListener('change', () => {
    localStorage.setItem(STORED, choice.value)
    apply(choice.value as Theme)
  })
  return choice
}

function stored(): Theme {
  const found = localStorage.getItem(STORED)
  return found === 'light' || found === 'dark' ? found : 'system'
}

function apply(theme: Theme): void {
  if (theme === 'system') delete document.documentElement.dataset['theme']
  else document.documentElement.dataset['theme'] = theme
  tell()
}

function tell(): void {
  for (const listener of listeners) listener()
}
