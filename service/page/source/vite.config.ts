import { defineConfig } from 'vite'
import { T } from './src/text.ts'

// Codecs of chunked image archives, which the viewer can read and this page never does.
const unusedCodecs = { find: /^numcodecs\/.*/, replacement: new URL('src/no_codec.ts', import.meta.url).pathname }

export default defineConfig({
  base: './',
  resolve: { alias: [unusedCodecs] },
  plugins: [
    {
      name: 'words',
      transformIndexHtml: (html) => html.replace('{title}', T.title).replace('{noscript}', T.noScript),
    },
  ],
  build: {
    assetsDir: 'page',
    license: { fileName: 'page/licences.md' },
    emptyOutDir: true,
    modulePreload: { polyfill: false },
    assetsInlineLimit: 0,
    chunkSizeWarningLimit: 1500,
    target: 'es2022',
  },
})
