// SPDX-License-Identifier: MIT
// node drive.mjs ASSETS CLIPS.json RAW: render clips in headless Chromium; the page posts its planes, which are stored in RAW.
// ASSETS holds node_modules/ and SuperTuxKart's data in stk/.
import fs from 'node:fs';
import http from 'node:http';
import path from 'node:path';
import {createRequire} from 'node:module';

const [assets, clips, raw] = process.argv.slice(2);
const puppeteer = createRequire(path.resolve(assets, 'node_modules/'))('puppeteer-core');
const ROOTS = {'/raster/': import.meta.dirname, '/modules/': path.join(assets, 'node_modules'), '/stk/': path.join(assets, 'stk')};
const TYPES = {'.html': 'text/html', '.js': 'text/javascript', '.xml': 'text/xml', '.png': 'image/png', '.jpg': 'image/jpeg'};
const CHROMIUM = ['--no-sandbox', '--use-gl=angle', '--use-angle=swiftshader', '--enable-unsafe-swiftshader',
  '--ignore-gpu-blocklist', '--disable-dev-shm-usage'];

function answer(request, response) {
  const name = decodeURIComponent(new URL(request.url, 'http://host').pathname);
  if (request.method === 'POST') {
    const file = fs.createWriteStream(path.join(raw, path.basename(name)));
    return request.pipe(file).on('finish', () => response.end());
  }
  const root = Object.keys(ROOTS).find(r => name.startsWith(r));
  const file = root && path.join(ROOTS[root], name.slice(root.length));
  if (!file || !fs.existsSync(file)) return response.writeHead(404).end();
  if (fs.statSync(file).isDirectory()) return response.end(JSON.stringify(fs.readdirSync(file)));
  response.setHeader('content-type', TYPES[path.extname(file).toLowerCase()] || 'application/octet-stream');
  fs.createReadStream(file).pipe(response);
}

fs.mkdirSync(raw, {recursive: true});
const server = http.createServer(answer).listen(0, '127.0.0.1');
await new Promise(ready => server.on('listening', ready));
const browser = await puppeteer.launch({executablePath: '/usr/bin/chromium', protocolTimeout: 3600e3, args: CHROMIUM});
try {
  const page = await browser.newPage();
  page.on('console', message => message.text().includes('404') || console.log(message.text()));
  page.on('pageerror', error => console.log(error.stack));
  await page.goto(`http://127.0.0.1:${server.address().port}/raster/page.html`);
  await page.evaluate(c => window.renderClips(c), JSON.parse(fs.readFileSync(clips)));
} finally {
  await browser.close();
  server.close();
}
