// By hand: the page of `extras/drive.py` in a real browser. Needs Debian's chromium and
// `npm install playwright-core`. Run: node tests/drive_browser.js PYTHON [maze1]
// It moves z_speed with the mouse, prints how fast the Ant then runs, and writes runs/figures/drive.png.
const { chromium } = require('playwright-core');
const { spawn } = require('child_process');
const fs = require('fs'), os = require('os'), path = require('path');
const root = path.dirname(__dirname), wait = ms => new Promise(done => setTimeout(done, ms));
const code = `
import runpy, sys, time
sys.path.insert(0, ${JSON.stringify(root)})
import common
step = common.Robots.step
def logged(self, action):
    print("at", time.monotonic(), *self.qpos[0, :2], flush=True)
    return step(self, action)
common.Robots.step = logged
sys.argv = ["drive.py", "--port", "0"] + sys.argv[1:]
runpy.run_path(${JSON.stringify(path.join(root, 'extras', 'drive.py'))}, run_name="__main__")`;
const walls = process.argv[3] ? ['--mazes', process.argv[3]] : [];
const python = spawn(process.argv[2] || 'python', ['-c', code, ...walls]);
let text = '';
python.stdout.on('data', data => { text += data; });
python.stderr.on('data', data => process.stderr.write(data));
const places = () => text.split('\n').slice(0, -1).filter(l => l.startsWith('at')).map(l => l.split(' ').slice(1).map(Number));
const speed = () => {
  const r = places().slice(-41), a = r[0], b = r[r.length - 1];
  return Math.hypot(b[1] - a[1], b[2] - a[2]) / (b[0] - a[0]);
};
(async () => {
  while (!/http:\S+/.test(text)) await wait(100);
  const context = await chromium.launchPersistentContext(fs.mkdtempSync(path.join(os.tmpdir(), 'drive')), {
    executablePath: '/usr/bin/chromium', headless: true, viewport: { width: 1000, height: 620 },
    args: ['--headless', '--no-sandbox', '--disable-gpu', '--disable-quic', '--no-first-run',
      '--disable-background-networking', '--disable-component-update', '--disable-sync'] });
  const page = context.pages()[0];
  const drawn = new Promise(done => page.on('console', m => { if (m.text().includes('Session roster')) done(); }));
  await page.goto(text.match(/http:\S+/)[0]);
  await drawn;
  await wait(4000);
  const x = v => 196 + v / 1.5 * 117, y = i => 102 + 26 * i;
  const drag = async (i, v) => {
    await page.mouse.move(x(0), y(i));
    await wait(1500);
    await page.mouse.down();
    await wait(2500);
    await page.mouse.move(x(v), y(i));
    await wait(2500);
    await page.mouse.up();
    await wait(3000);
  };
  for (const v of [1.2, -1.2, 0.4]) {
    await drag(0, v);
    console.log(`z_speed ${v}: the Ant runs at ${speed().toFixed(2)} m/s`);
  }
  await drag(2, -0.8);
  await wait(4000);
  const figures = path.join('runs', 'figures');
  fs.mkdirSync(figures, { recursive: true });
  await page.screenshot({ path: path.join(figures, 'drive.png') });
  const r = places();
  console.log(`${((r.length - 1) / (r[r.length - 1][0] - r[0][0])).toFixed(2)} steps a second over ${r.length} steps`);
  await context.close();
  python.kill('SIGINT');
})();
