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
  return { view: 'reconstruct', result: view === 'result' && identifier ? decodeURIComponent(identifier) : null }
}

/** Change the address without leaving what is shown. */
export function rewrite(hash: string): void {
  history.replaceState(null, '', `${location.pathname}${location.search}#/${hash}`)
}

export function resultLink(id: string): string {
  return `${location.origin}${location.pathname}#/result/${encodeURIComponent(id)}`
}
