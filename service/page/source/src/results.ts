/** Results of this browser window, so that two of them can be compared. */

export interface Known {
  id: string
  label: string
}

const STORED = 'morphoflow-results'
const MOST = 12

export function knownResults(): Known[] {
  try {
    return JSON.parse(sessionStorage.getItem(STORED) ?? '[]') as Known[]
  } catch {
    return []
  }
}

export function remember(result: Known): void {
  const others = knownResults().filter((known) => known.id !== result.id)
  sessionStorage.setItem(STORED, JSON.stringify([result, ...others].slice(0, MOST)))
}

export function dismiss(id: string): void {
  sessionStorage.setItem(STORED, JSON.stringify(knownResults().filter((known) => known.id !== id)))
}
