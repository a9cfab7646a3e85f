// Shows the tiles under data/ (or the folder that ?data= names). Nothing is asked of any other machine.
"use strict";

const query = new URLSearchParams(location.search);
const source = query.get("data") || "data";
const trouble = text => { document.getElementById("trouble").textContent = text; window.failed = text; };
const colourOf = level => Cesium.Color.fromHsl(level * 0.381966 % 1, 0.55, 0.55);
// From blue, a tenth of a metre, to red, a kilometre.
const colourOfError = error => Cesium.Color.fromHsl(0.66 * (1 - Math.min(Math.max((Math.log10(error) + 1) / 4, 0), 1)), 0.6, 0.55);

// A colour for each level: what is drawn is as deep as the ground under it.
class LevelImagery {
    constructor(colour) {
        this.colour = colour;
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
        pen.fillStyle = this.colour(level).toCssColorString();
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

function tell(levels) {
    const rows = levels.map(({ tiles, error }, level) => tiles
        ? `<tr><td><span class="swatch" style="background:${colourOf(level).toCssColorString()}"></span></td>` +
            `<td>${level}</td><td>${tiles}</td><td>${error >= 10 ? error.toFixed(0) : error.toPrecision(2)} m</td></tr>` : "");
    document.getElementById("levels").innerHTML = rows.join("");
}

const on = (name, event, act) => document.getElementById(name).addEventListener(event, act);

function makeViewer(options) {
    const viewer = new Cesium.Viewer("globe", {
        baseLayer: false, baseLayerPicker: false, geocoder: false, timeline: false, animation: false, homeButton: false,
        sceneModePicker: false, navigationHelpButton: false, infoBox: false, selectionIndicator: false,
        fullscreenButton: false, skyBox: false, ...options
    });
    window.viewer = viewer;
    viewer.scene.fog.enabled = false;
    return viewer;
}

// Light from the north-west, 40 degrees above the horizon of the data.
function light(viewer, middle) {
    const frame = Cesium.Transforms.eastNorthUpToFixedFrame(middle);
    viewer.scene.light = new Cesium.DirectionalLight({
        direction: Cesium.Matrix4.multiplyByPointAsVector(frame, new Cesium.Cartesian3(0.54, -0.54, -0.64), new Cesium.Cartesian3())
    });
}

function onPixels(act) {
    on("pixels", "input", e => {
        act(+e.target.value);
        document.getElementById("pixelsTold").textContent = e.target.value;
    });
}

// For judges: the page is at rest.
function watch(viewer, done) {
    let frames = 0;
    viewer.scene.postRender.addEventListener(() => { window.rest = ++frames > 20 && done(); });
}

// ---- 3D Tiles ----

// Height above the ellipsoid, to a metre, or the slope, as places in a ramp.
function shaderOf(kind, range) {
    if (kind !== "height" && kind !== "slope")
        return undefined;
    const stops = kind === "height" ? ["#3f6b46", "#a8b56c", "#c9a66b", "#8d7a6b", "#f5f5f5"] : ["#f4f1e8", "#d9b36c", "#a2453a", "#3a1f3d"];
    return new Cesium.CustomShader({
        uniforms: {
            u_ramp: { type: Cesium.UniformType.SAMPLER_2D, value: new Cesium.TextureUniform({ url: ramp(stops).toDataURL() }) },
            u_range: { type: Cesium.UniformType.VEC2, value: new Cesium.Cartesian2(...range) }
        },
        fragmentShaderText: kind === "height" ? `void fragmentMain(FragmentInput fsInput, inout czm_modelMaterial material) {
                vec3 p = fsInput.attributes.positionWC, radii = vec3(6378137.0, 6378137.0, 6356752.3142);
                float h = length(p) * (1.0 - 1.0 / length(p / radii));
                material.diffuse = texture(u_ramp, vec2((h - u_range.x) / (u_range.y - u_range.x), 0.5)).rgb;
            }` : `void fragmentMain(FragmentInput fsInput, inout czm_modelMaterial material) {
                vec3 up = czm_viewRotation * normalize(fsInput.attributes.positionWC);
                float slope = acos(clamp(dot(normalize(fsInput.attributes.normalEC), up), -1.0, 1.0));
                material.diffuse = texture(u_ramp, vec2(slope / 1.5707963, 0.5)).rgb;
            }`
    });
}

async function show3d(json) {
    const levels = json.extras.talus.errors.map(error => ({ tiles: "&le;", error }));
    tell(levels);
    document.getElementById("other").href += location.search;
    document.getElementById("other").hidden = false;
    const viewer = makeViewer({ globe: false, skyAtmosphere: false });
    viewer.scene.backgroundColor = Cesium.Color.fromCssColorString("#28323c");
    const tileset = await Cesium.Cesium3DTileset.fromUrl(`${source}/tileset.json`, { enableDebugWireframe: true, maximumScreenSpaceError: 2 });
    tileset.environmentMapManager.enabled = false;
    viewer.scene.primitives.add(tileset);
    window.tileset = tileset;
    tileset.imageBasedLighting.imageBasedLightingFactor = new Cesium.Cartesian2(0.4, 0);
    const [west, south, east, north, low, high] = json.extras.talus.region;
    const sphere = Cesium.BoundingSphere.fromRectangle3D(new Cesium.Rectangle(west, south, east, north), Cesium.Ellipsoid.WGS84, (low + high) / 2);
    light(viewer, sphere.center);
    viewer.scene.light.intensity = 3;
    let shown = "ground";
    tileset.tileVisible.addEventListener(tile => {
        const level = tile.implicitCoordinates ? tile.implicitCoordinates.level : 0;
        tile.color = shown === "level" ? colourOf(level) : shown === "error" ? colourOfError(tile.geometricError) : Cesium.Color.WHITE;
    });
    const fly = duration => viewer.camera.flyToBoundingSphere(sphere, { duration, offset: new Cesium.HeadingPitchRange(0, -0.6, 2 * sphere.radius) });
    on("fly", "click", () => fly(2));
    on("wires", "change", e => { tileset.debugWireframe = e.target.checked; });
    onPixels(pixels => { tileset.maximumScreenSpaceError = pixels; });
    const range = [low, high];
    on("colours", "change", e => {
        shown = e.target.value;
        tileset.customShader = shaderOf(shown, range);
    });
    fly(0);
    watch(viewer, () => tileset.tilesLoaded && tileset.statistics.selected > 0);
}

// ---- quantized-mesh ----

async function showTerrain(layer) {
    const errors = layer.talus ? layer.talus.errors : [];
    tell(layer.available.map((ranges, level) => {
        const tiles = ranges.reduce((sum, r) => sum + (r.endX - r.startX + 1) * (r.endY - r.startY + 1), 0);
        return { tiles: tiles ? `${tiles} tiles` : "", error: level < errors.length ? errors[level] : NaN };
    }));
    const terrain = await Cesium.CesiumTerrainProvider.fromUrl(source, { requestVertexNormals: true });
    const viewer = makeViewer({ terrainProvider: terrain });
    const globe = viewer.scene.globe;
    globe.baseColor = Cesium.Color.fromCssColorString("#8f9a78");
    globe.enableLighting = true;
    globe.showGroundAtmosphere = false;
    const [west, south, east, north] = layer.bounds, middle = [(west + east) / 2, (south + north) / 2];
    const heights = (await Cesium.sampleTerrainMostDetailed(terrain, Array.from({ length: 81 }, (_, k) =>
        Cesium.Cartographic.fromDegrees(west + (east - west) * (k % 9 + 0.5) / 9, south + (north - south) * (Math.floor(k / 9) + 0.5) / 9))))
        .map(p => p.height).filter(Number.isFinite);
    const range = [Math.min(...heights), Math.max(...heights)];
    light(viewer, Cesium.Cartesian3.fromDegrees(...middle));

    function fly(duration) {
        const size = Math.max(north - south, (east - west) * Math.cos(middle[1] * Math.PI / 180)) * 111000;
        viewer.camera.flyTo({ duration, destination: Cesium.Cartesian3.fromDegrees(middle[0], middle[1] - 0.9 * size / 111000, range[1] + 0.55 * size),
            orientation: { heading: 0, pitch: -0.6, roll: 0 } });
    }

    on("fly", "click", () => fly(2));
    on("wires", "change", e => { globe._surface.tileProvider._debug.wireframe = e.target.checked; });
    onPixels(pixels => { globe.maximumScreenSpaceError = pixels; });
    on("colours", "change", e => {
        viewer.imageryLayers.removeAll();
        globe.material = material(e.target.value, range);
        if (e.target.value === "level")
            viewer.imageryLayers.addImageryProvider(new LevelImagery(colourOf));
        if (e.target.value === "error")
            viewer.imageryLayers.addImageryProvider(new LevelImagery(level => colourOfError(errors[Math.min(level, errors.length - 1)])));
    });
    fly(0);
    watch(viewer, () => globe.tilesLoaded);
}

async function begin() {
    const kinds = [["tileset.json", show3d], ["layer.json", showTerrain]];
    for (const [name, show] of kinds) {
        const answer = await fetch(`${source}/${name}`);
        if (answer.ok)
            return show(await answer.json());
    }
    throw new Error(`${source}: has neither tileset.json nor layer.json`);
}

begin().catch(failure => trouble(String(failure && failure.stack || failure)));
