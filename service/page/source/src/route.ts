/** What the part of the address after # asks for. */

export type Route =
  | { view: 'reconstruct'; result: string | null }
  | { view: 'draw' }
  | { view: 'explore'; query: URLSearchParams }

export function currentRoute(): Route {
  const [path = '', query = ''] = location.hash.replace(/^#\/?/, '').split('?')
  const [view, identifier] = path.split('/')
  if (view === 'draw') return { view }
  if (view === 'explore') return { view, query: new URLSearchParams(query) }
  return { view: 'reconstruct', result: view === 'result' && identifier ? decoded(identifier) : null }
}

/** Without its escapes; what is not properly escaped stays as it is. */
export function decoded(text: string): string {
  try {
    return decodeURIComponent(text)
  } catch {
    return text
  }
}

/** Change the address without leaving what is shown. */
export function rewrite(hash: string): void {
  history.replaceState(null, '', `${location.pathname}${location.search}#/${hash}`)
}

/** What follows `#/` in the address of a result. */
export function resultPlace(id: string): string {
  return `result/${encodeURIComponent(id)}`
}

export function resultLink(id: string): string {
  return `${location.origin}${location.pathname}#/${resultPlace(id)}`
}
