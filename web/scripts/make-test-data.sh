#!/bin/sh
# Makes the models and reference pictures of the headless test with `fathom`: about 5 minutes on 2 cores.
#
#   scripts/make-test-data.sh FATHOM DATA [quick]
#
# FATHOM is the program, DATA the folder to fill. The test reads DATA from VIEWER_DATA, or from test-data/.
# With `quick` there are only two small models, one for each form of the water. Otherwise a wreck of a real
# survey is trained too, if SESA (default: ../shared/scenes/sesa-wreck beside the repository) is there.
set -eu
web=$(cd "$(dirname "$0")/.." && pwd)
fathom=$1
data=$2
mkdir -p "$data/renders"

render() {
    name=$1 folder=$2
    shift 2
    "$fathom" render "$data/$name/model.ply" --cameras "$data/$name/cameras.json" --allow-cpu \
        -o "$data/renders/$name/$folder" "$@"
}

# Range and alpha of each pixel, from which a test fits the water back.
ranges() {
    render "$1" ranges --size 600x450 --maps range,alpha
}

# A copy for viewing, and pages to hand over. The name and the credits try to be markup.
handover() {
    mkdir -p "$data/handover"
    cp -r "$data/pixel" "$data/handover/<script>wreck & co"
    "$fathom" export "$data/pixel" -o "$data/handover/model.compressed.ply"
    "$fathom" export "$data/handover/<script>wreck & co" --html "$data/handover/page.html" \
        --photographs "$data/wreck" \
        --credits '</script><script>document.title = "taken"</script> Photographs: <b>us</b> & co. CC BY 4.0'
    view='c%3D0%2C-2%2C0%2C-0.7071068%2C0%2C0%2C0.7071068%26f%3D50%26m%3Dwater%2Cnone%26s%3D0.5%26w%3D1'
    "$fathom" export "$data/pixel" --html "$data/handover/views.html" \
        --views "http://127.0.0.1:1/x/view.html#c=0,-3,0,-0.7071068,0,0,0.7071068&f=50&m=clear,none&s=0.5&w=1&b=Bow+%3C1%3E~$view"
}

# A few cameras of a survey of hundreds, and pictures of them.
survey() {
    scene=${SESA:-$web/../../shared/scenes/sesa-wreck}
    if [ ! -d "$scene/sparse" ]; then
        echo "$scene is not there, so its model is not made"
        return
    fi
    "$fathom" train "$scene" -o "$data/sesa" --allow-cpu --max-gaussians 6000 --iterations 300 \
        --max-resolution 160 --test-every 100
    "$web/node_modules/.bin/node" --input-type=module - "$data/sesa/cameras.json" <<'END'
import { readFileSync, writeFileSync } from 'node:fs';
const [path] = process.argv.slice(2);
const some = JSON.parse(readFileSync(path, 'utf8')).filter((_, i) => i % 58 === 0);
writeFileSync(path, JSON.stringify(some));
END
    render sesa clear --max-resolution 160
    render sesa water --max-resolution 160 --water on
}

if [ "${3:-}" = quick ]; then
    "$fathom" synth "$data/wreck" --views 16 --size 120x90
    set -- --allow-cpu --max-gaussians 3000 --iterations 150
    "$fathom" train "$data/wreck" -o "$data/pixel" --partitions 2x1 "$@"
    "$fathom" train "$data/wreck" -o "$data/gaussian" --set water.medium=per_gaussian "$@"
    for name in pixel gaussian; do
        render "$name" clear --maps alpha,normal
        render "$name" water --water on
        render "$name" veil --water only
    done
    ranges pixel
    handover
    exit
fi

"$fathom" synth "$data/wreck" --views 24 --size 200x150
"$fathom" synth "$data/reef" --look forward --views 24 --size 200x150

train() {
    name=$1 scene=$2
    shift 2
    "$fathom" train "$data/$scene" -o "$data/$name" --allow-cpu --max-gaussians 5000 "$@"
}
train pixel wreck --iterations 600 --partitions 2x1
train gaussian wreck --iterations 600 --set water.medium=per_gaussian
train gaussian_linear wreck --iterations 300 --set water.medium=per_gaussian --set water.blend=linear
train maps wreck --iterations 600 --set water.blend=linear --set water.dbdr.mode=maps
train open reef --iterations 600
train air wreck --iterations 300 --preset 3dgs --set train.mip_filter=true

# The same model, as if it had been trained in clear water: `render` reads the header alone.
mkdir -p "$data/over_black"
cp "$data/pixel/cameras.json" "$data/pixel/plan.json" "$data/over_black/"
LC_ALL=C sed 's/"blend":"srgb"/"blend":"over_black"/' "$data/pixel/model.ply" > "$data/over_black/model.ply"

# A model in other axes than its cameras and its water.
mkdir -p "$data/aligned"
"$fathom" export "$data/open" --frame aligned -o "$data/aligned/model.ply"
cp "$data/open/cameras.json" "$data/open/plan.json" "$data/aligned/"

for name in pixel gaussian gaussian_linear maps open aligned air over_black; do
    render "$name" clear --maps alpha,normal
done
for name in pixel gaussian gaussian_linear maps open aligned over_black; do
    render "$name" water --water on
    render "$name" veil --water only
done
ranges pixel
ranges open
handover
survey
