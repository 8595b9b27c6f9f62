// The shaders, in GLSL for WebGL2.
//
// The engine reads the Gaussians: its chunks give getCenter, getRotation, getScale, getColor and readSHData
// for every file format that it knows. Projection and blending follow `fathom render`
// (shaders/project_forward.wgsl, shaders/rasterize_forward.wgsl), where the engine differs:
//
//   - it fades a Gaussian out at 2.8 standard deviations; the trainer cuts it off where alpha falls below 1/255
//   - it leaves out Gaussians smaller than two pixels
//   - it does not limit the slope in the Jacobian, so Gaussians beside the picture become too wide
//   - its work buffer rounds shape and opacity to 8 bits

/** What the colour of a Gaussian is in a pass; the numbers up to 5 are MEDIUM_* of shaders/shared/water.wgsl. */
export const Paint = {
    /** Its colour in sRGB. */
    own: 0,
    /** Under water, in linear light. */
    waterLinear: 1,
    /** Its colour in linear light. */
    ownLinear: 2,
    /** Only the veil in front of it, in linear light. */
    veilLinear: 3,
    /** Under water, in sRGB. */
    waterSrgb: 4,
    veilSrgb: 5,
    /** Its shortest axis, towards the camera, in camera axes: (n + 1) / 2. */
    normal: 8,
    /** The colour of its partition, with some of its own brightness. */
    partition: 9,
} as const;
export type Paint = (typeof Paint)[keyof typeof Paint];

/** What the last pass shows. */
export const Shown = { clear: 0, water: 1, veil: 2, range: 3, normal: 4, alpha: 5, partition: 6 } as const;
export type Shown = (typeof Shown)[keyof typeof Shown];

const CURVES = `
// The sRGB curve (IEC 61966-2-1). It continues above 1.
vec3 decodedLight(vec3 s) {
    vec3 v = max(s, vec3(0.0));
    return mix(pow((v + 0.055) / 1.055, vec3(2.4)), v / 12.92, vec3(lessThanEqual(v, vec3(0.04045))));
}
vec3 encodedLight(vec3 l) {
    vec3 v = max(l, vec3(0.0031308));
    return mix(1.055 * pow(v, vec3(1.0 / 2.4)) - 0.055, 12.92 * l, vec3(lessThanEqual(l, vec3(0.0031308))));
}
`;

/** One Gaussian as a quad around its ellipse. */
export const SPLAT_VERTEX = `
attribute vec3 vertex_position; // corner in xy, -1 to 1; number within the instance in z

uniform highp usampler2D uOrder;
uniform int uOrderWidth;
uniform int uCount;
// Rows of world to camera: rotation in xyz, translation in w; x right, y down, z forward.
uniform vec4 uViewX;
uniform vec4 uViewY;
uniform vec4 uViewZ;
uniform vec3 uEye;
// fx, fy, cx, cy, pixels from the top left.
uniform vec4 uLens;
uniform vec2 uSize;
// Bounds of x/z and y/z inside the Jacobian: minimum, maximum.
uniform vec4 uRatio;
uniform int uAntialiased;
// Harmonics that the file has. Of a compressed PLY the engine gives 15; it fills the others with a code near 0.
uniform int uHarmonics;
uniform int uPaint;
// Water that acts on Gaussians, already scaled by the amount of water.
uniform vec3 uBetaD;
uniform vec3 uBetaB;
uniform vec3 uInfinity;
#ifdef HAS_PARTITIONS
uniform highp usampler2D uPartitions;
#endif

#include "gsplatFormatVS"
#include "gsplatSplatVS"
#include "gsplatDeclarationsVS"
#include "gsplatEvalSHVS"
#include "gsplatQuatToMat3VS"
#include "gsplatReadVS"

varying highp vec2 vDeviations;
flat varying highp vec3 vColour;
flat varying highp vec2 vOpacityRange;

const float NEAR = 0.01;
const float BLUR = 0.3;
const vec4 NOWHERE = vec4(0.0, 0.0, 2.0, 1.0);

${CURVES}

// A colour that differs from its neighbours, by number: hues in steps of the golden angle.
vec3 colourOfNumber(uint number) {
    float hue = fract(0.08 + float(number) * 0.61803398875);
    vec3 wheel = clamp(abs(fract(hue + vec3(0.0, 2.0 / 3.0, 1.0 / 3.0)) * 6.0 - 3.0) - 1.0, 0.0, 1.0);
    return mix(vec3(0.95), wheel, 0.55);
}

vec3 painted(vec3 rgb, float range, vec3 normal) {
    if (uPaint == ${Paint.own}) {
        return rgb;
    }
    if (uPaint == ${Paint.ownLinear}) {
        return decodedLight(rgb);
    }
    if (uPaint == ${Paint.normal}) {
        return 0.5 * normal + 0.5;
    }
    if (uPaint == ${Paint.partition}) {
        uint number = 0u;
        #ifdef HAS_PARTITIONS
            number = texelFetch(uPartitions, splat.uv, 0).r;
        #endif
        float brightness = dot(min(rgb, vec3(1.0)), vec3(0.3, 0.55, 0.15));
        return colourOfNumber(number) * (0.35 + 0.65 * brightness);
    }
    bool veilOnly = uPaint == ${Paint.veilLinear} || uPaint == ${Paint.veilSrgb};
    vec3 own = veilOnly ? vec3(0.0) : decodedLight(rgb);
    vec3 light = own * exp(-uBetaD * range) + uInfinity * (1.0 - exp(-uBetaB * range));
    return uPaint >= ${Paint.waterSrgb} ? encodedLight(light) : light;
}

void main(void) {
    gl_Position = NOWHERE;
    int place = gl_InstanceID * {INSTANCE_SIZE} + int(vertex_position.z);
    if (place >= uCount) {
        return;
    }
    setSplat(texelFetch(uOrder, ivec2(place % uOrderWidth, place / uOrderWidth), 0).r);

    vec3 mean = getCenter();
    vec3 centre = vec3(dot(uViewX.xyz, mean) + uViewX.w, dot(uViewY.xyz, mean) + uViewY.w,
                       dot(uViewZ.xyz, mean) + uViewZ.w);
    if (!(centre.z > NEAR)) {
        return;
    }
    mat3 axes = quatToMat3(getRotation());
    vec3 scales = getScale();
    vec4 colour = getColor();

    // Covariance of the projection (Zwicker et al. 2002): A = J W R S, cov = A A^T.
    vec2 ratio = clamp(centre.xy / centre.z, uRatio.xy, uRatio.zw);
    vec3 rowX = (uLens.x / centre.z) * (uViewX.xyz - ratio.x * uViewZ.xyz);
    vec3 rowY = (uLens.y / centre.z) * (uViewY.xyz - ratio.y * uViewZ.xyz);
    vec3 ax = (rowX * axes) * scales;
    vec3 ay = (rowY * axes) * scales;
    vec3 cov = vec3(dot(ax, ax) + BLUR, dot(ax, ay), dot(ay, ay) + BLUR);
    float det = cov.x * cov.z - cov.y * cov.y;
    if (!(det > 0.0)) {
        return;
    }
    float opacity = colour.a;
    if (uAntialiased != 0) {
        // Mip-Splatting: the low-pass must not add to a Gaussian.
        opacity *= length(cross(ax, ay)) / sqrt(det);
    }
    // alpha >= 1/255 where half the squared deviations are at most this.
    float reach = log(255.0 * opacity);
    if (!(reach > 0.0)) {
        return;
    }

    // Off the picture: nothing more needs to be read.
    vec2 middlePixel = uLens.xy * centre.xy / centre.z + uLens.zw;
    vec2 extent = sqrt(2.0 * reach * cov.xz) + 1.0;
    if (any(lessThan(middlePixel + extent, vec2(0.0))) || any(greaterThan(middlePixel - extent, uSize))) {
        return;
    }

    // Axes of the ellipse.
    float middle = 0.5 * (cov.x + cov.z);
    float radius = length(vec2(0.5 * (cov.x - cov.z), cov.y));
    float major = middle + radius;
    float minor = max(det / major, 0.0);
    vec2 along = abs(cov.y) > 1e-12 * major ? normalize(vec2(cov.y, major - cov.x))
        : (cov.x >= cov.z ? vec2(1.0, 0.0) : vec2(0.0, 1.0));
    // Slack for the fragments on the rim.
    vec2 deviations = vertex_position.xy * (sqrt(2.0 * reach) * 1.005);
    vec2 offset = deviations.x * sqrt(major) * along + deviations.y * sqrt(minor) * vec2(-along.y, along.x);
    vec2 pixel = middlePixel + offset;

    #if SH_BANDS > 0
        vec3 sh[SH_COEFFS];
        float shScale;
        readSHData(sh, shScale);
        for (int k = 0; k < SH_COEFFS; k++) {
            sh[k] = k < uHarmonics ? sh[k] : vec3(0.0);
        }
        colour.rgb += evalSH(sh, normalize(mean - uEye)) * shScale;
    #endif

    vec3 normal = vec3(0.0);
    if (uPaint == ${Paint.normal}) {
        vec3 shortest = scales.x <= scales.y && scales.x <= scales.z ? axes[0] : (scales.y <= scales.z ? axes[1] : axes[2]);
        shortest *= dot(shortest, uEye - mean) < 0.0 ? -1.0 : 1.0;
        normal = vec3(dot(uViewX.xyz, shortest), dot(uViewY.xyz, shortest), dot(uViewZ.xyz, shortest));
    }
    float range = length(centre);
    vColour = painted(max(colour.rgb, vec3(0.0)), range, normal);
    vOpacityRange = vec2(opacity, range);
    vDeviations = deviations;
    gl_Position = vec4(2.0 * pixel.x / uSize.x - 1.0, 1.0 - 2.0 * pixel.y / uSize.y, 0.0, 1.0);
}
`;

/** Premultiplied colour and range. */
export const SPLAT_FRAGMENT = `
varying highp vec2 vDeviations;
flat varying highp vec3 vColour;
flat varying highp vec2 vOpacityRange;

void main(void) {
    float alpha = min(0.99, vOpacityRange.x * exp(-0.5 * dot(vDeviations, vDeviations)));
    if (!(alpha >= 1.0 / 255.0)) {
        discard;
    }
    pcFragColor0 = vec4(vColour * alpha, alpha);
    // Blending uses the alpha of each output.
    pcFragColor1 = vec4(vOpacityRange.y * alpha, 0.0, 0.0, alpha);
}
`;

export const FULL_VERTEX = `
attribute vec2 aPosition;
void main(void) {
    gl_Position = vec4(aPosition, 0.0, 1.0);
}
`;

/** From blended colours, alpha and range to what is shown, in sRGB. */
export const RESOLVE_FRAGMENT = `
uniform highp sampler2D uColour;
uniform highp sampler2D uRange;
// Pixels from the lower left corner of the picture.
uniform vec2 uOffset;
uniform vec2 uSize;
uniform vec4 uLens;
// Camera to world, for the rays: columns are the camera axes.
uniform vec3 uRight;
uniform vec3 uDown;
uniform vec3 uForward;
uniform int uShown;
// Composition of water.ts.
uniform int uComposition;
uniform vec3 uWaterD;
uniform vec3 uWaterB;
uniform vec3 uWaterInfinity;
// How many times the usual distance the water is.
uniform float uAmount;
// scale, 1/unit; scale 0: coefficients do not depend on the range.
uniform vec2 uRefinement;
uniform vec4 uRefinementWeights;
// Change of log b_inf with direction: slope and offset; most 0: the same in all directions.
uniform vec4 uRed;
uniform vec4 uGreen;
uniform vec4 uBlue;
uniform float uMost;
// Nearest and farthest range of the colour scale.
uniform vec2 uRangeScale;
uniform vec3 uBackground;

const float LEAST_ALPHA = 1e-3;

${CURVES}

vec3 openWater(vec2 pixel) {
    if (uMost == 0.0) {
        return uWaterInfinity;
    }
    vec3 ray = normalize(vec3((pixel - uLens.zw) / uLens.xy, 1.0));
    vec4 d = vec4(ray.x * uRight + ray.y * uDown + ray.z * uForward, 1.0);
    vec3 change = vec3(dot(uRed, d), dot(uGreen, d), dot(uBlue, d));
    return uWaterInfinity * exp(clamp(change, vec3(-uMost), vec3(uMost)));
}

vec2 refinementAt(float range) {
    if (uRefinement.x == 0.0) {
        return vec2(1.0);
    }
    vec2 x = uRefinementWeights.xz * (range * uRefinement.y) + uRefinementWeights.yw;
    return uRefinement.x / (1.0 + exp(-clamp(x, vec2(-30.0), vec2(30.0))));
}

vec3 underWater(vec4 seen, float range, vec2 pixel, bool veilOnly) {
    // With less water than usual, open water fades too. At 0 there is no water at all.
    float share = min(uAmount, 1.0);
    vec3 infinity = openWater(pixel);
    if (uComposition == 0) {
        return veilOnly ? vec3(0.0) : seen.rgb;
    }
    if (uComposition == 1) {
        return seen.rgb + (1.0 - seen.a) * share * encodedLight(uWaterInfinity);
    }
    if (uComposition == 2) {
        return encodedLight(seen.rgb + (1.0 - seen.a) * share * uWaterInfinity);
    }
    bool overBlack = uComposition == 5;
    if (!(seen.a >= LEAST_ALPHA)) {
        return overBlack ? vec3(0.0) : encodedLight(share * infinity);
    }
    float r = uAmount * range / seen.a;
    vec2 factors = refinementAt(r);
    vec3 own = overBlack ? decodedLight(seen.rgb)
        : (uComposition == 4 ? seen.rgb : seen.a * decodedLight(seen.rgb / seen.a));
    vec3 veil = infinity * (seen.a * (1.0 - exp(-uWaterB * factors.y * r)) + (overBlack ? 0.0 : share * (1.0 - seen.a)));
    return encodedLight(veilOnly ? veil : own * exp(-uWaterD * factors.x * r) + veil);
}

// Near is light, far is dark.
vec3 colourOfRange(float t) {
    vec3 c = mix(vec3(0.99, 0.95, 0.79), vec3(0.96, 0.66, 0.42), smoothstep(0.0, 0.25, t));
    c = mix(c, vec3(0.80, 0.33, 0.36), smoothstep(0.25, 0.5, t));
    c = mix(c, vec3(0.38, 0.20, 0.45), smoothstep(0.5, 0.75, t));
    return mix(c, vec3(0.07, 0.10, 0.24), smoothstep(0.75, 1.0, t));
}

void main(void) {
    vec2 corner = gl_FragCoord.xy - uOffset;
    vec4 seen = texelFetch(uColour, ivec2(corner), 0);
    float range = texelFetch(uRange, ivec2(corner), 0).r;
    vec2 pixel = vec2(corner.x, uSize.y - corner.y);
    vec3 rgb;
    if (uShown == ${Shown.clear}) {
        bool linear = uComposition == 2 || uComposition == 4;
        rgb = linear ? encodedLight(seen.rgb) : seen.rgb;
    } else if (uShown == ${Shown.water}) {
        rgb = underWater(seen, range, pixel, false);
    } else if (uShown == ${Shown.veil}) {
        rgb = underWater(seen, range, pixel, true);
    } else if (uShown == ${Shown.range}) {
        float t = clamp((range / max(seen.a, 1e-6) - uRangeScale.x) / (uRangeScale.y - uRangeScale.x), 0.0, 1.0);
        rgb = mix(uBackground, colourOfRange(t), smoothstep(0.02, 0.3, seen.a));
    } else if (uShown == ${Shown.normal}) {
        vec3 sum = 2.0 * seen.rgb - seen.a;
        rgb = length(sum) > 1e-3 * seen.a ? 0.5 * normalize(sum) + 0.5 : vec3(0.5);
    } else if (uShown == ${Shown.alpha}) {
        rgb = vec3(seen.a);
    } else {
        rgb = seen.rgb + (1.0 - seen.a) * uBackground;
    }
    gl_FragColor = vec4(clamp(rgb, 0.0, 1.0), 1.0);
}
`;
