// Draws Gaussians with the engine: its device, its readers of model files and its shader chunks.
//
// A frame has two passes. The first blends the Gaussians over black into two float targets: premultiplied
// colour with alpha, and range. The second turns each pixel into what is shown (RESOLVE_FRAGMENT). If the two
// sides of the divider need different colours of Gaussians, each side of the targets is drawn with its own.

import {
    AppBase,
    AppOptions,
    Asset,
    BLENDEQUATION_ADD,
    BLENDMODE_ONE,
    BLENDMODE_ONE_MINUS_SRC_ALPHA,
    BlendState,
    CULLFACE_NONE,
    Color,
    DepthState,
    FILTER_NEAREST,
    GSplatComponentSystem,
    GSplatHandler,
    GSplatResourceBase,
    Mesh,
    PIXELFORMAT_R16F,
    PIXELFORMAT_R32F,
    PIXELFORMAT_R32U,
    PIXELFORMAT_R8U,
    PIXELFORMAT_RGBA16F,
    PIXELFORMAT_RGBA8,
    QuadRender,
    RenderPass,
    RenderTarget,
    SEMANTIC_POSITION,
    type Shader,
    ShaderMaterial,
    ShaderUtils,
    Texture,
    TextureHandler,
    Vec4,
    WebglGraphicsDevice,
} from 'playcanvas';

import { type Pinhole, type Pose, worldToCamera } from './camera.ts';
import { ViewerError } from './errors.ts';
import { FULL_VERTEX, Paint, RESOLVE_FRAGMENT, SPLAT_FRAGMENT, SPLAT_VERTEX, Shown } from './shaders.ts';
import type { Sorted } from './sorter.ts';
import { type Quat, type Vec3, dot, matOfQuat, quatMul, rotate } from './vector.ts';
import { Composition, type WaterRecord, actsOnGaussians, blendsInLinearLight, compositionOf } from './water.ts';

/** What one side of the divider shows. */
export type Mode = 'clear' | 'water' | 'veil' | 'range' | 'normal' | 'alpha' | 'partition';

/** A rectangle, pixels from the lower left corner, as WebGL counts. */
interface Rect {
    readonly x: number;
    readonly y: number;
    readonly width: number;
    readonly height: number;
}

export interface Frame {
    readonly pose: Pose;
    readonly camera: Pinhole;
    readonly left: Mode;
    readonly right: Mode;
    /** Where the right side begins, 0 to 1; 1 shows only the left side. */
    readonly split: number;
    /** How many times the usual distance the water is. */
    readonly amount: number;
    /** Nearest and farthest range of the colour scale, scene units. */
    readonly rangeScale: readonly [number, number];
    /** sRGB, 0 to 1. */
    readonly background: Vec3;
}

/** Gaussians of one instance. The engine draws as many; small instances are slow on most GPUs. */
const INSTANCE = 128;
const OVER = new BlendState(
    true,
    BLENDEQUATION_ADD,
    BLENDMODE_ONE,
    BLENDMODE_ONE_MINUS_SRC_ALPHA,
    BLENDEQUATION_ADD,
    BLENDMODE_ONE,
    BLENDMODE_ONE_MINUS_SRC_ALPHA,
);
/** Share of the picture by which the Jacobian may look beyond its edge, as in the trainer. */
const MARGIN = 0.15;

class DrawPass extends RenderPass {
    #draw: () => void = () => {};

    override execute(): void {
        this.#draw();
    }

    run(target: RenderTarget | null, clear: Color | null, draw: () => void): void {
        this.#draw = draw;
        // The engine takes null for "no options", but its types do not say so.
        this.init(target, {} as never);
        this.setClearColor(clear as never);
        this.render();
    }
}

/** A model on the device. */
interface Model {
    /** The file that the engine holds. */
    readonly asset: Asset;
    /** From scene axes to those of the model. */
    readonly toModel: Quat;
    readonly resource: GSplatResourceBase;
    /** Parameters of the file format: textures and numbers. */
    readonly material: ShaderMaterial;
    readonly shader: Shader;
    readonly order: Texture;
    readonly partitions: Texture | null;
    readonly antialiased: boolean;
    /** Coefficients of the harmonics beyond the constant one, by channel. */
    readonly harmonics: number;
    count: number;
}

function paintOf(mode: Mode, composition: Composition): Paint {
    const linear = blendsInLinearLight(composition);
    if (mode === 'normal') {
        return Paint.normal;
    }
    if (mode === 'partition') {
        return Paint.partition;
    }
    if (actsOnGaussians(composition) && mode === 'water') {
        return linear ? Paint.waterLinear : Paint.waterSrgb;
    }
    if (actsOnGaussians(composition) && mode === 'veil') {
        return linear ? Paint.veilLinear : Paint.veilSrgb;
    }
    return linear ? Paint.ownLinear : Paint.own;
}

export class Renderer {
    readonly #canvas: HTMLCanvasElement;
    readonly #app: AppBase;
    readonly #device: WebglGraphicsDevice;
    readonly #quad: Mesh;
    readonly #resolve: QuadRender;
    readonly #pass: DrawPass;
    readonly #rangeFormat: number;
    #targets: RenderTarget | null = null;
    #model: Model | null = null;
    /** A model that was loaded and replaces the other one once it is sorted. */
    #next: Model | null = null;
    #loadedModels = 0;
    #water: WaterRecord | null = null;

    constructor(canvas: HTMLCanvasElement, onLost: () => void, onRestored: () => void) {
        this.#canvas = canvas;
        try {
            this.#device = new WebglGraphicsDevice(canvas, {
                antialias: false,
                alpha: false,
                depth: false,
                stencil: false,
                powerPreference: 'high-performance',
            } as never);
        } catch (error) {
            throw new ViewerError(
                'This browser cannot draw in 3D: it gives no WebGL2.',
                'Use a current browser, and turn on hardware acceleration in its settings. On a computer without a ' +
                    'graphics card, Chromium draws slowly with --enable-unsafe-swiftshader.',
                error,
            );
        }
        if (!this.#device.textureHalfFloatRenderable) {
            throw new ViewerError(
                'This device cannot draw into float textures, which the water needs.',
                'Use another device or browser; WebGL2 needs the extension EXT_color_buffer_float.',
            );
        }
        // Half floats count ranges to 1/2048 of their size, which is enough where floats cannot be blended.
        const hasFloats = this.#device.textureFloatRenderable && this.#device.textureFloatBlendable;
        this.#rangeFormat = hasFloats ? PIXELFORMAT_R32F : PIXELFORMAT_R16F;
        const options = new AppOptions();
        options.graphicsDevice = this.#device;
        // This system brings the shader chunks that read Gaussians.
        options.componentSystems = [GSplatComponentSystem] as never;
        options.resourceHandlers = [GSplatHandler, TextureHandler] as never;
        this.#app = new AppBase(canvas);
        this.#app.init(options);
        this.#device.on('devicelost', onLost);
        this.#device.on('devicerestored', onRestored);
        this.#quad = quads(this.#device);
        this.#pass = new DrawPass(this.#device);
        this.#resolve = new QuadRender(
            ShaderUtils.createShader(this.#device, {
                uniqueName: 'FathomResolve',
                attributes: { aPosition: SEMANTIC_POSITION },
                vertexGLSL: FULL_VERTEX,
                fragmentGLSL: RESOLVE_FRAGMENT,
            }),
        );
    }

    /** Largest side of a picture, pixels. */
    get largestSide(): number {
        return this.#device.maxTextureSize;
    }

    /**
     * Reads a model, which replaces one before it with the next order of its Gaussians. `toModel` turns scene
     * axes into those of the model. Returns the centres of the Gaussians, model axes.
     */
    async load(
        response: Response,
        name: string,
        kind: 'ply' | 'sog',
        antialiased: boolean,
        toModel: Quat,
    ): Promise<Float32Array> {
        const asset = await this.#parse(response, name, kind);
        const resource = asset.resource as unknown as GSplatResourceBase;
        const centres = resource.centers;
        if (!centres) {
            throw new ViewerError(`${name} holds no positions.`, 'Download the model again.');
        }
        const material = new ShaderMaterial({ uniqueName: 'FathomFormat', vertexGLSL: '', fragmentGLSL: '' } as never);
        resource.configureMaterial(material, null, resource.format.getInputDeclarations());
        const { shBands } = resource.gsplatData as { readonly shBands?: number };
        const width = Math.min(2048, this.#device.maxTextureSize);
        const height = Math.ceil(resource.numSplats / width);
        this.#next = {
            asset,
            toModel,
            resource,
            material,
            shader: this.#splatShader(material, false),
            order: this.#texture('order', PIXELFORMAT_R32U, width, height),
            partitions: null,
            antialiased,
            harmonics: [0, 3, 8, 15][shBands ?? 3] ?? 15,
            count: 0,
        };
        return centres;
    }

    /** The water, in scene axes; null for none. */
    setWater(water: WaterRecord | null): void {
        this.#water = water;
    }

    /** The number of the partition of each Gaussian, in the order of the centres. */
    setPartitions(numbers: Uint8Array): void {
        const model = this.#loaded();
        model.partitions?.destroy();
        const { x: width, y: height } = model.resource.textureDimensions;
        const partitions = this.#texture('partitions', PIXELFORMAT_R8U, width, height);
        (partitions.lock() as Uint8Array).set(numbers);
        partitions.unlock();
        const changed = { ...model, partitions, shader: this.#splatShader(model.material, true) };
        if (this.#next === null) {
            this.#model = changed;
        } else {
            this.#next = changed;
        }
    }

    setOrder(sorted: Sorted): void {
        const model = this.#loaded();
        (model.order.lock() as Uint32Array).set(sorted.order.subarray(0, sorted.count));
        model.order.unlock();
        model.count = sorted.count;
        if (this.#next !== null) {
            this.#free(this.#model);
            [this.#model, this.#next] = [this.#next, null];
        }
    }

    /** Draws a frame to the canvas. `area` is the rectangle of the picture, pixels from the lower left. */
    draw(frame: Frame, area: Rect): void {
        const { width, height } = this.#canvas;
        if (this.#device.width !== width || this.#device.height !== height) {
            this.#device.setResolution(width, height);
        }
        this.#device.frameStart();
        this.#blend(frame);
        const [r, g, b] = frame.background;
        this.#pass.run(null, new Color(r, g, b, 1), () => this.#show(frame, area));
        this.#device.frameEnd();
    }

    /** A picture of the camera's size, rows from the top, RGBA. */
    async picture(frame: Frame): Promise<Uint8ClampedArray<ArrayBuffer>> {
        const { width, height } = frame.camera;
        const colorBuffer = this.#texture('picture', PIXELFORMAT_RGBA8, width, height);
        const target = new RenderTarget({ colorBuffer, depth: false });
        try {
            this.#device.frameStart();
            this.#blend(frame);
            this.#pass.run(target, new Color(0, 0, 0, 1), () => this.#show(frame, { x: 0, y: 0, width, height }));
            this.#device.frameEnd();
            const read = (await colorBuffer.read(0, 0, width, height, {
                renderTarget: target,
                immediate: true,
            })) as Uint8Array;
            const flipped = new Uint8ClampedArray(width * height * 4);
            for (let row = 0; row < height; row++) {
                flipped.set(read.subarray(row * width * 4, (row + 1) * width * 4), (height - 1 - row) * width * 4);
            }
            return flipped;
        } finally {
            target.destroy();
            colorBuffer.destroy();
        }
    }

    /** The expected range at a pixel of the last frame, from the lower left; null where nothing is. */
    async rangeAt(x: number, y: number): Promise<number | null> {
        const targets = this.#targets;
        if (targets === null || x < 0 || y < 0 || x >= targets.width || y >= targets.height) {
            return null;
        }
        // Half floats arrive as bits; one number of them is turned into a float below.
        const colour = (await this.#read(targets, 0, x, y)) as Uint16Array;
        const range = await this.#read(targets, 1, x, y);
        const alpha = halfToFloat(colour[3] ?? 0);
        const sum = this.#rangeFormat === PIXELFORMAT_R16F ? halfToFloat(range[0] ?? 0) : (range[0] ?? 0);
        return alpha > 0.3 ? sum / alpha : null;
    }

    /** Waits until the device has drawn what it was given; for measuring. */
    finish(): void {
        const gl = (this.#device as unknown as { gl: WebGL2RenderingContext }).gl;
        gl.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    }

    destroy(): void {
        this.#targets?.destroy();
        this.#app.destroy();
    }

    /** The model that was loaded last. */
    #loaded(): Model {
        const model = this.#next ?? this.#model;
        if (model === null) {
            throw new Error('no model is loaded');
        }
        return model;
    }

    #free(model: Model | null): void {
        if (model !== null) {
            this.#app.assets.remove(model.asset);
            // This frees what the engine made of the file.
            model.asset.unload();
            model.order.destroy();
            model.partitions?.destroy();
        }
    }

    #parse(response: Response, name: string, kind: 'ply' | 'sog'): Promise<Asset> {
        // Of two files at one address the engine would read only the first.
        this.#loadedModels += 1;
        const file = `model-${this.#loadedModels}.${kind}`;
        // The engine picks a reader by the ending of the address, and fetches nothing when it has contents.
        const asset = new Asset(
            name,
            'gsplat',
            { url: file, filename: file, contents: response } as never,
            // The order of the rows is kept: Fathom's rows are already close to their neighbours.
            { reorder: false } as never,
        );
        return new Promise((resolve, reject) => {
            asset.on('load', () => resolve(asset));
            asset.on('error', (why: unknown) =>
                reject(
                    new ViewerError(
                        `${name} cannot be read as a model: ${String(why)}.`,
                        'Download it again. Formats that can be read are .ply, .compressed.ply and .sog.',
                        why,
                    ),
                ),
            );
            this.#app.assets.add(asset);
            this.#app.assets.load(asset);
        });
    }

    #splatShader(material: ShaderMaterial, hasPartitions: boolean): Shader {
        const defines = new Map<string, string>();
        for (const [key, value] of material.defines as Map<string, unknown>) {
            defines.set(key, String(value));
        }
        defines.set('{INSTANCE_SIZE}', String(INSTANCE));
        if (hasPartitions) {
            defines.set('HAS_PARTITIONS', '');
        }
        const chunks = material.getShaderChunks('glsl') as unknown as Map<string, string>;
        return ShaderUtils.createShader(this.#device, {
            uniqueName: `FathomSplats${[...defines].join(';')}${chunks.get('gsplatReadVS') ?? ''}`,
            attributes: { vertex_position: SEMANTIC_POSITION },
            vertexGLSL: SPLAT_VERTEX,
            fragmentGLSL: SPLAT_FRAGMENT,
            vertexIncludes: new Map(chunks),
            vertexDefines: defines,
        });
    }

    #texture(name: string, format: number, width: number, height: number): Texture {
        return new Texture(this.#device, {
            name,
            format,
            width,
            height,
            mipmaps: false,
            minFilter: FILTER_NEAREST,
            magFilter: FILTER_NEAREST,
        });
    }

    #read(targets: RenderTarget, index: number, x: number, y: number): Promise<ArrayLike<number>> {
        return targets.getColorBuffer(index).read(x, y, 1, 1, { immediate: true }) as Promise<ArrayLike<number>>;
    }

    #set(name: string, value: unknown): void {
        this.#device.scope.resolve(name).setValue(value as never);
    }

    /** Targets of the size of a picture. */
    #targetsFor(width: number, height: number): RenderTarget {
        let targets = this.#targets;
        if (targets === null || targets.width !== width || targets.height !== height) {
            if (targets !== null) {
                targets.destroyTextureBuffers();
                targets.destroy();
            }
            targets = new RenderTarget({
                colorBuffers: [
                    this.#texture('colour', PIXELFORMAT_RGBA16F, width, height),
                    this.#texture('range', this.#rangeFormat, width, height),
                ],
                depth: false,
            });
            this.#targets = targets;
        }
        return targets;
    }

    #sides(frame: Frame): { mode: Mode; x: number; width: number }[] {
        const { width } = frame.camera;
        const edge = Math.round(Math.min(1, Math.max(0, frame.split)) * width);
        return [
            { mode: frame.left, x: 0, width: edge },
            { mode: frame.right, x: edge, width: width - edge },
        ].filter((side) => side.width > 0);
    }

    #blend(frame: Frame): void {
        const { width, height } = frame.camera;
        const composition = compositionOf(this.#water);
        const sides = this.#sides(frame);
        const paints = new Set(sides.map((side) => paintOf(side.mode, composition)));
        this.#pass.run(this.#targetsFor(width, height), new Color(0, 0, 0, 0), () => {
            if (paints.size <= 1) {
                this.#splats(frame, sides[0]?.mode ?? 'clear');
                return;
            }
            for (const side of sides) {
                this.#device.setScissor(side.x, 0, side.width, height);
                this.#splats(frame, side.mode);
            }
            this.#device.setScissor(0, 0, width, height);
        });
    }

    #splats(frame: Frame, mode: Mode): void {
        const model = this.#model;
        if (model === null || model.count === 0) {
            return;
        }
        const { camera } = frame;
        const pose = inModel(model, frame.pose);
        const { rotation, translation } = worldToCamera(pose);
        const rows = ['uViewX', 'uViewY', 'uViewZ'];
        rows.forEach((name, i) => this.#set(name, [...rotation[i as 0 | 1 | 2], translation[i as 0 | 1 | 2]]));
        this.#set('uEye', [...pose.position]);
        this.#set('uLens', [camera.fx, camera.fy, camera.cx, camera.cy]);
        this.#set('uSize', [camera.width, camera.height]);
        const [mx, my] = [MARGIN * camera.width, MARGIN * camera.height];
        this.#set('uRatio', [
            (-camera.cx - mx) / camera.fx,
            (-camera.cy - my) / camera.fy,
            (camera.width - camera.cx + mx) / camera.fx,
            (camera.height - camera.cy + my) / camera.fy,
        ]);
        this.#set('uAntialiased', model.antialiased ? 1 : 0);
        this.#set('uHarmonics', model.harmonics);
        this.#set('uPaint', paintOf(mode, compositionOf(this.#water)));
        const times = (v: Vec3 | undefined): number[] => (v ?? [0, 0, 0]).map((value) => value * frame.amount);
        this.#set('uBetaD', times(this.#water?.beta_d));
        this.#set('uBetaB', times(this.#water?.beta_b));
        this.#set('uInfinity', [...(this.#water?.b_inf ?? [0, 0, 0])]);
        this.#set('uOrder', model.order);
        this.#set('uOrderWidth', model.order.width);
        this.#set('uCount', model.count);
        if (model.partitions !== null) {
            this.#set('uPartitions', model.partitions);
        }
        const parameters = model.material.parameters as Record<string, { data: unknown }>;
        for (const [name, parameter] of Object.entries(parameters)) {
            this.#set(name, parameter.data);
        }
        const device = this.#device;
        device.setBlendState(OVER);
        device.setDepthState(DepthState.NODEPTH);
        device.setCullMode(CULLFACE_NONE);
        device.setShader(model.shader);
        device.setVertexBuffer(this.#quad.vertexBuffer);
        const [primitive, indices] = [this.#quad.primitive[0], this.#quad.indexBuffer[0]];
        device.draw(primitive as never, indices as never, Math.ceil(model.count / INSTANCE), undefined);
    }

    #show(frame: Frame, area: Rect): void {
        const targets = this.#targets;
        if (targets === null) {
            return;
        }
        const water = this.#water;
        const { camera, pose } = frame;
        const axes = matOfQuat(pose.rotation);
        const column = (i: 0 | 1 | 2): number[] => [axes[0][i], axes[1][i], axes[2][i]];
        this.#set('uColour', targets.getColorBuffer(0));
        this.#set('uRange', targets.getColorBuffer(1));
        this.#set('uOffset', [area.x, area.y]);
        this.#set('uSize', [camera.width, camera.height]);
        this.#set('uLens', [camera.fx, camera.fy, camera.cx, camera.cy]);
        this.#set('uRight', column(0));
        this.#set('uDown', column(1));
        this.#set('uForward', column(2));
        this.#set('uComposition', compositionOf(water));
        this.#set('uWaterD', [...(water?.beta_d ?? [0, 0, 0])]);
        this.#set('uWaterB', [...(water?.beta_b ?? [0, 0, 0])]);
        this.#set('uWaterInfinity', [...(water?.b_inf ?? [0, 0, 0])]);
        this.#set('uAmount', frame.amount);
        const refinement = water?.refinement;
        this.#set('uRefinement', refinement ? [refinement.scale, 1 / refinement.unit] : [0, 0]);
        const weights = refinement ? [...refinement.attenuation, ...refinement.backscatter] : [0, 0, 0, 0];
        this.#set('uRefinementWeights', weights);
        const by = water?.by_direction;
        ['uRed', 'uGreen', 'uBlue'].forEach((name, i) => {
            const slope = by?.slopes[i as 0 | 1 | 2];
            this.#set(name, by && slope ? [...slope, -dot(slope, by.middle)] : [0, 0, 0, 0]);
        });
        this.#set('uMost', by?.most ?? 0);
        this.#set('uRangeScale', [...frame.rangeScale]);
        this.#set('uBackground', [...frame.background]);
        this.#device.setBlendState(BlendState.NOBLEND);
        this.#device.setDepthState(DepthState.NODEPTH);
        this.#device.setCullMode(CULLFACE_NONE);
        const viewport = new Vec4(area.x, area.y, area.width, area.height);
        for (const side of this.#sides(frame)) {
            this.#set('uShown', Shown[side.mode]);
            this.#resolve.render(viewport, new Vec4(area.x + side.x, area.y, side.width, area.height));
        }
    }

    /** A pose for the sorter, whose centres are in the axes of the model that was loaded last. */
    poseForSorting(pose: Pose): Pose {
        return inModel(this.#loaded(), pose);
    }
}

/** A pose in the axes of a model. */
const inModel = ({ toModel }: Model, pose: Pose): Pose => ({
    position: rotate(toModel, pose.position),
    rotation: quatMul(toModel, pose.rotation),
});

function quads(device: WebglGraphicsDevice): Mesh {
    const positions: number[] = [];
    const indices: number[] = [];
    for (let i = 0; i < INSTANCE; i++) {
        positions.push(-1, -1, i, 1, -1, i, 1, 1, i, -1, 1, i);
        indices.push(...[0, 1, 2, 0, 2, 3].map((corner) => 4 * i + corner));
    }
    const mesh = new Mesh(device);
    mesh.setPositions(positions, 3);
    mesh.setIndices(indices);
    mesh.update();
    return mesh;
}

function halfToFloat(bits: number): number {
    const sign = bits & 0x8000 ? -1 : 1;
    const exponent = (bits >> 10) & 31;
    const fraction = bits & 1023;
    if (exponent === 0) {
        return sign * fraction * 2 ** -24;
    }
    return exponent === 31 ? Number.NaN : sign * (1 + fraction / 1024) * 2 ** (exponent - 15);
}
