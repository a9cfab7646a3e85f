// One terrain mesh, made by a peer or read from a PLY, and its true error by brute force.
//
//   node mesh.mjs martini|delatin FOLDER HEIGHTS SIZE ERROR MESH   makes a mesh and stores it
//   node mesh.mjs check HEIGHTS SIZE MESH                          prints JSON: triangles, error, samples
//
// FOLDER is where npm installed the peers, HEIGHTS a file of SIZE x SIZE little-endian floats, row by row. A stored
// mesh is a binary PLY in columns, rows and heights, as `talus simplify --frame pixel` writes it.
import {readFileSync, writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {pathToFileURL} from 'node:url';

function readHeights(path, size) {
    const bytes = readFileSync(path);
    const heights = new Float32Array(bytes.buffer, bytes.byteOffset, bytes.byteLength / 4);
    if (heights.length !== size * size) throw new Error(`${path}: not ${size} x ${size} floats`);
    return heights;
}

async function load(folder, name) {
    const root = join(folder, 'node_modules', name);
    const about = JSON.parse(readFileSync(join(root, 'package.json')));
    const module = await import(pathToFileURL(join(root, about.main || about.module || 'index.js')));
    return module.default;
}

const makers = {
    async martini(folder, heights, size, error) {
        const Martini = await load(folder, '@mapbox/martini');
        const {vertices, triangles} = new Martini(size).createTile(heights).getMesh(error);
        return {coords: vertices, triangles};
    },
    async delatin(folder, heights, size, error) {
        const Delatin = await load(folder, 'delatin');
        const mesh = new Delatin(heights, size, size);
        mesh.run(error);
        return mesh;
    }
};

function writePly(path, {coords, triangles}, heights, size) {
    const vertices = coords.length / 2, faces = triangles.length / 3;
    const header = 'ply\nformat binary_little_endian 1.0\n' +
        `element vertex ${vertices}\nproperty float x\nproperty float y\nproperty float z\n` +
        `element face ${faces}\nproperty list uchar uint vertex_indices\nend_header\n`;
    const out = Buffer.alloc(header.length + 12 * vertices + 13 * faces);
    let at = out.write(header, 'latin1');
    for (let k = 0; k < vertices; k++) {
        const x = coords[2 * k], y = coords[2 * k + 1];
        for (const value of [x, y, heights[y * size + x]]) at = out.writeFloatLE(value, at);
    }
    for (let t = 0; t < faces; t++) {
        at = out.writeUInt8(3, at);
        for (let k = 0; k < 3; k++) at = out.writeUInt32LE(triangles[3 * t + k], at);
    }
    writeFileSync(path, out);
}

// PLYs of three floats a vertex and a list of 32-bit indices a face.
function readPly(path) {
    const bytes = readFileSync(path), end = bytes.indexOf('end_header\n') + 11;
    const header = bytes.toString('latin1', 0, end);
    const vertices = Number(/element vertex (\d+)/.exec(header)[1]), faces = Number(/element face (\d+)/.exec(header)[1]);
    const xyz = new Float64Array(3 * vertices), triangles = new Uint32Array(3 * faces);
    let at = end;
    for (let k = 0; k < xyz.length; k++, at += 4) xyz[k] = bytes.readFloatLE(at);
    for (let t = 0; t < faces; t++, at += 13)
        for (let k = 0; k < 3; k++) triangles[3 * t + k] = bytes.readUInt32LE(at + 1 + 4 * k);
    return {xyz, triangles};
}

// The largest difference of any sample from any triangle that covers it, over the bounding box of each.
function check({xyz, triangles}, heights, size) {
    const covered = new Uint8Array(size * size);
    let worst = 0;
    for (let t = 0; t < triangles.length; t += 3) {
        const [a, b, c] = [3 * triangles[t], 3 * triangles[t + 1], 3 * triangles[t + 2]];
        const ax = xyz[a], ay = xyz[a + 1], bx = xyz[b], by = xyz[b + 1], cx = xyz[c], cy = xyz[c + 1];
        const area = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax), turn = Math.sign(area);
        if (!area) continue;
        for (let y = Math.min(ay, by, cy); y <= Math.max(ay, by, cy); y++)
            for (let x = Math.min(ax, bx, cx); x <= Math.max(ax, bx, cx); x++) {
                const u = (bx - x) * (cy - y) - (by - y) * (cx - x), v = (cx - x) * (ay - y) - (cy - y) * (ax - x);
                if (u * turn < 0 || v * turn < 0 || (area - u - v) * turn < 0) continue;
                const z = (u * xyz[a + 2] + v * xyz[b + 2] + (area - u - v) * xyz[c + 2]) / area;
                worst = Math.max(worst, Math.abs(z - heights[y * size + x]));
                covered[y * size + x] = 1;
            }
    }
    return {triangles: triangles.length / 3, error: worst, uncovered: covered.length - covered.reduce((s, k) => s + k, 0)};
}

const [what, ...rest] = process.argv.slice(2);
if (what === 'check') {
    const [path, size, mesh] = rest;
    console.log(JSON.stringify(check(readPly(mesh), readHeights(path, Number(size)), Number(size))));
} else {
    const [folder, path, size, error, mesh] = rest;
    const heights = readHeights(path, Number(size));
    writePly(mesh, await makers[what](folder, heights, Number(size), Number(error)), heights, Number(size));
}
