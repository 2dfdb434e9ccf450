//! Whole models: consent, download or export, check, installation, replacement, kills.
use super::server::{File, Server, plain};
use super::sha256;
use splatlab::generate::regions::InjectedErrors;
use splatlab::generate::{SceneSpec, generate};
use splatvk::fetch::{self, Client, Limits};
use splatvk::infer::Registry;
use splatvk::infer::catalogue::{CatalogueEntry, catalogue};
use splatvk::progress::Silent;
use splatvk_test_support::onnx::{Attribute, FLOAT, INT64, Onnx};
use std::io::{Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::Duration;

/// A depth network that returns the brightness of a pixel. Not for commercial use, one file without
/// a checksum in the catalogue.
const DEPTH: &str = "depth_anything_v2_large";

fn depth_network(padding: usize) -> Vec<u8> {
    Onnx::new()
        .input("pixel_values", FLOAT, "1 3 28 28")
        .output("predicted_depth", "1 28 28")
        .weight("unused", &[padding as u64], &vec![0.5; padding])
        .node(
            "ReduceMean",
            "pixel_values",
            "predicted_depth",
            &[("axes", Attribute::Ints(&[1])), ("keepdims", Attribute::Int(0))],
        )
        .encode()
}

/// Towers for three colours: image, text and tokenizer.
pub fn clip_graphs() -> (Onnx, Onnx, String) {
    // Images are normalised by CLIP's mean and deviation.
    towers(["image", "text"], "embedding", [1.79, 1.75, 1.48])
}

/// Towers with the interface of SigLIP.
pub fn siglip_graphs() -> (Onnx, Onnx, String) {
    towers(["pixel_values", "input_ids"], "pooler_output", [1.0; 3])
}

/// Towers of colours with these names of inputs and of the output; adding `black` to a normalised
/// black image gives zero.
fn towers([image, text]: [&str; 2], embedding: &str, black: [f32; 3]) -> (Onnx, Onnx, String) {
    let image = Onnx::new()
        .input(image, FLOAT, "batch 3 16 16")
        .output(embedding, "batch 3")
        .weight("black", &[3], &black)
        .node(
            "ReduceMean",
            image,
            "mean",
            &[("axes", Attribute::Ints(&[2, 3])), ("keepdims", Attribute::Int(0))],
        )
        .node("Add", "mean black", embedding, &[]);
    let words = ["[UNK]", "red", "green", "blue"];
    let mut table = vec![0.01f32; 3 * words.len()];
    (0..3).for_each(|k| table[3 * (k + 1) + k] = 100.0);
    let text = Onnx::new()
        .input(text, INT64, "1 8")
        .output(embedding, "1 3")
        .weight("table", &[words.len() as u64, 3], &table)
        .integers("axis", &[1])
        .node("Gather", &format!("table {text}"), "rows", &[])
        .node("ReduceSum", "rows axis", embedding, &[("keepdims", Attribute::Int(0))]);
    let vocabulary: Vec<String> = words.iter().enumerate().map(|(i, w)| format!("\"{w}\": {i}")).collect();
    let tokenizer = format!(
        r#"{{"version": "1.0", "truncation": null, "padding": null, "added_tokens": [], "normalizer": {{"type": "Lowercase"}},
            "pre_tokenizer": {{"type": "Whitespace"}}, "post_processor": null, "decoder": null,
            "model": {{"type": "WordLevel", "vocab": {{{}}}, "unk_token": "[UNK]"}}}}"#,
        vocabulary.join(", ")
    );
    (image, text, tokenizer)
}

fn clip() -> [(&'static str, Vec<u8>); 3] {
    let (image, text, tokenizer) = clip_graphs();
    [("image.onnx", image.encode()), ("text.onnx", text.encode()), ("tokenizer.json", tokenizer.into_bytes())]
}

/// A model folder that does not exist yet, in a temporary one.
struct Place {
    folder: tempfile::TempDir,
}

impl Place {
    fn new() -> Place {
        Place { folder: tempfile::tempdir().unwrap() }
    }

    fn models(&self) -> PathBuf {
        self.folder.path().join("models")
    }

    fn at(&self, path: &str) -> PathBuf {
        self.models().join(path)
    }

    /// `splatvk models …` with this folder and a mirror.
    fn command(&self, arguments: &[&str], mirror: &str) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        command.arg("models").args(arguments).arg("--models").arg(self.models()).stdin(Stdio::null());
        for name in ["ALL_PROXY", "all_proxy", "HTTPS_PROXY", "https_proxy", "HTTP_PROXY", "http_proxy"] {
            command.env_remove(name);
        }
        command.env("SPLATVK_MODELS_MIRROR", mirror).env_remove("SSL_CERT_FILE");
        command
    }

    fn fetch(&self, arguments: &[&str], mirror: &str) -> Command {
        self.command(&[&["fetch"], arguments].concat(), mirror)
    }

    fn hidden(&self) -> Vec<String> {
        let list = std::fs::read_dir(self.models()).into_iter().flatten().flatten();
        list.map(|e| e.file_name().to_string_lossy().into_owned()).filter(|n| n.starts_with('.')).collect()
    }
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

fn succeeds(command: &mut Command) -> String {
    let Output { status, stdout, stderr } = command.output().unwrap();
    assert!(status.success(), "{}", text(&stderr));
    text(&stdout)
}

/// Expects a failure with one error line.
fn refuses(command: &mut Command, code: i32, words: &[&str]) {
    let Output { status, stderr, .. } = command.output().unwrap();
    let stderr = text(&stderr);
    let lines: Vec<&str> = stderr.lines().filter(|l| l.starts_with("splatvk: ")).collect();
    assert!(status.code() == Some(code) && lines.len() == 1, "{status}: {stderr}");
    assert!(words.iter().all(|w| lines[0].contains(w)), "{words:?}: {}", lines[0]);
}

/// Serves one body under every name.
fn serving(body: &[u8]) -> Server {
    let file = File::new(body);
    Server::start(move |r, _, s| file.send(r, s))
}

#[test]
fn dry_run_lists_addresses_and_files() {
    let place = Place::new();
    let server = serving(b"");
    let ids: Vec<&str> = catalogue().iter().map(|k| k.id.as_str()).filter(|id| *id != "lseg").collect();
    let arguments = [&ids[..], &["--dry-run"]].concat();
    let told = succeeds(&mut place.fetch(&arguments, ""));
    let json = succeeds(&mut place.fetch(&[&arguments[..], &["--json"]].concat(), ""));
    let json: serde_json::Value = serde_json::from_str(&json).unwrap();
    for (entry, planned) in
        catalogue().iter().filter(|k| k.id != "lseg").zip(json["models"].as_array().unwrap())
    {
        let weights = entry.recipe.iter().flat_map(|r| &r.weights);
        for (k, source) in entry.files.iter().chain(weights).enumerate() {
            assert!(told.contains(&format!("{} → {}", source.from, source.name)), "{}: {told}", source.from);
            assert_eq!(planned["files"][k]["address"], source.from.as_str());
        }
        for word in [&entry.id, &entry.licence] {
            assert!(told.contains(word.as_str()), "{word}: {told}");
        }
        assert_eq!(planned["commands"].as_array().unwrap().is_empty(), entry.recipe.is_none());
        if let Some(recipe) = &entry.recipe {
            assert!(told.contains(&recipe.script) && told.contains("-m venv"), "{told}");
        }
    }
    let mirrored = succeeds(&mut place.fetch(&["open", "--dry-run"], &server.address));
    assert!(
        mirrored.contains(&format!("{}/onnx-community/sam2.1-hiera-small-ONNX/resolve/", server.address)),
        "{mirrored}"
    );
    assert!(!mirrored.contains("huggingface.co"), "{mirrored}");
    assert!(server.requests().is_empty() && !place.models().exists());
}

#[test]
fn fetch_needs_licence_consent() {
    let place = Place::new();
    let server = serving(&depth_network(1));
    refuses(&mut place.fetch(&["open"], &server.address), 2, &["--yes", "MB"]);
    refuses(&mut place.fetch(&["lemon"], &server.address), 2, &["lemon", "open, paper", "mobile_sam"]);
    refuses(&mut place.fetch(&["lseg"], &server.address), 2, &["no public source", "tools/export"]);
    let licence = ["CC-BY-NC-4.0", "--accept depth_anything_v2_large"];
    refuses(&mut place.fetch(&[DEPTH, "--yes"], &server.address), 2, &licence);
    let other = [DEPTH, "vggt", "--yes", "--accept", "vggt"];
    refuses(&mut place.fetch(&other, &server.address), 2, &licence);
    refuses(&mut place.fetch(&[DEPTH, "--dry-run"], "ftp://x"), 2, &["SPLATVK_MODELS_MIRROR=ftp://x"]);
    assert!(server.requests().is_empty() && !place.models().exists());
}

#[test]
fn fetched_model_is_used_and_replaced() {
    let place = Place::new();
    let network = depth_network(1);
    let server = serving(&network);
    let get = [DEPTH, "--yes", "--accept", DEPTH];
    let told = succeeds(&mut place.fetch(&get, &server.address));
    for part in
        [&sha256(&network), "pinned from now on", "depth of 2 photos", "auto takes depth_anything_v2_large"]
    {
        assert!(told.contains(part), "{part}: {told}");
    }
    assert!(place.hidden().is_empty(), "{:?}", place.hidden());
    let list = succeeds(&mut place.command(&["list", "--json"], ""));
    let list: serde_json::Value = serde_json::from_str(&list).unwrap();
    assert_eq!(list["networks"][0]["name"], DEPTH);
    assert_eq!(list["networks"][0]["graphs"][0]["sha256"][0]["pinned"], sha256(&network).as_str());
    server.requests();
    let again = succeeds(&mut place.fetch(&get, &server.address));
    assert!(again.contains("is there") && server.requests().is_empty(), "{again}");

    // The source serves other content now: it contradicts the checksum pinned at the first fetch.
    let forced = [&get[..], &["--force"]].concat();
    let other = serving(&depth_network(2));
    refuses(&mut place.fetch(&forced, &other.address), 3, &["has changed since it was first fetched"]);
    assert_eq!(std::fs::read(place.at(DEPTH).join("model.onnx")).unwrap(), network);
    // The installed file was changed.
    std::fs::write(place.at(DEPTH).join("model.onnx"), depth_network(3)).unwrap();
    refuses(&mut place.fetch(&get, &server.address), 3, &["was pinned", "--force"]);
    succeeds(&mut place.fetch(&forced, &server.address));
    assert_eq!(std::fs::read(place.at(DEPTH).join("model.onnx")).unwrap(), network);
    assert!(place.hidden().is_empty(), "{:?}", place.hidden());
}

#[test]
fn fetch_refuses_foreign_files() {
    let place = Place::new();
    let server = serving(b"<html>Log in to this network</html>");
    let get = [DEPTH, "--yes", "--accept", DEPTH];
    refuses(
        &mut place.fetch(&get, &server.address),
        3,
        &["nothing was installed", "not a complete ONNX file"],
    );
    // An invalid graph in a valid file.
    let place = Place::new();
    let network = Onnx::new()
        .input("pixel_values", FLOAT, "1 3 28 28")
        .output("predicted_depth", "1 28 28")
        .weight("nothing", &[1], &[f32::NAN])
        .node(
            "ReduceMean",
            "pixel_values",
            "mean",
            &[("axes", Attribute::Ints(&[1])), ("keepdims", Attribute::Int(0))],
        )
        .node("Mul", "mean nothing", "predicted_depth", &[]);
    let server = serving(&network.encode());
    refuses(&mut place.fetch(&get, &server.address), 3, &["nothing was installed", "NaN"]);
    assert!(!place.at(DEPTH).exists() && place.hidden() == [format!(".fetch-{DEPTH}")]);
    // Such a model as replacement of an installed one.
    std::fs::create_dir(place.at(DEPTH)).unwrap();
    std::fs::write(place.at(DEPTH).join("model.onnx"), depth_network(1)).unwrap();
    refuses(&mut place.fetch(&[&get[..], &["--force"]].concat(), &server.address), 3, &["NaN"]);
    assert_eq!(std::fs::read(place.at(DEPTH).join("model.onnx")).unwrap(), depth_network(1));
    let clean = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        command.env("SPLATVK_HOME", place.folder.path().join("home"));
        command.arg("clean").args(more).arg("--models").arg(place.models());
        succeeds(&mut command)
    };
    assert!(
        clean(&[]).contains("models that were fetched in part: holds 0.0 MiB in 1 files"),
        "{}",
        clean(&[])
    );
    clean(&["--delete"]);
    assert!(place.hidden().is_empty() && place.at(DEPTH).exists());
    // A model that a killed process had moved aside is restored.
    super::command::abandon(&place.at(".fetch-da3"), "da3");
    std::fs::rename(place.at(DEPTH), place.at(".fetch-da3/old")).unwrap();
    clean(&["--delete"]);
    assert!(place.hidden().is_empty() && place.at("da3/model.onnx").exists());
    // A folder of such a name without a mark, and a link to one, belong to the user.
    std::fs::create_dir(place.at(".fetch-mine")).unwrap();
    std::fs::write(place.at(".fetch-mine/letter"), "precious").unwrap();
    #[cfg(unix)]
    std::os::unix::fs::symlink(place.at("da3"), place.at(".fetch-linked")).unwrap();
    clean(&["--delete"]);
    assert!(place.at(".fetch-mine/letter").exists() && place.at("da3/model.onnx").exists());
    assert_eq!(std::fs::read_dir(place.at("da3")).unwrap().count(), 1, "no lock is made there");
}

/// Fetches the towers of [`clip_graphs`] as one model `clip_toy` into `place`.
fn fetch_clip(place: &Place) -> (Registry, fetch::Report) {
    std::fs::create_dir(place.models()).unwrap();
    let files = clip();
    let listed: Vec<String> = files
        .iter()
        .map(|(name, body)| {
            let (from, sum) = (format!("https://models.example/{name}"), sha256(body));
            format!("{{ from = {from:?}, name = {name:?}, bytes = {}, sha256 = {sum:?} }}", body.len())
        })
        .collect();
    let entry: CatalogueEntry = toml::from_str(&format!(
        "id = \"clip_toy\"\nname = \"toy\"\nrole = \"features\"\nfamily = \"clip\"\npacks = []\nlicence = \"MIT\"\nmegabytes = 1\n\
         source = \"https://models.example\"\nexport = \"none\"\nfiles = [{}]",
        listed.join(", ")
    ))
    .unwrap();
    let server = Server::start(move |r, _, s| {
        let file = files.iter().find(|(name, _)| r.path == format!("/{name}"));
        match file {
            Some((_, body)) => File::new(body).send(r, s),
            None => plain(s, "404 Not Found", &[]),
        }
    });
    let client = Client::new(Some(&server.address), None, Limits::default()).unwrap();
    let registry = Registry::open(Some(&place.models())).unwrap();
    let report = fetch::fetch(&entry, &registry, &place.models(), &client, &Silent).unwrap();
    (registry, report)
}

#[test]
fn library_fetches_model_of_several_files() {
    let place = Place::new();
    let (registry, report) = fetch_clip(&place);
    assert_eq!((report.files.len(), report.folder), (3, place.at("clip_toy")));
    assert!(
        report.steps.iter().any(|s| s.step == "2 regions") && report.steps.iter().any(|s| s.step == "1 text")
    );
    let found = splatvk::infer::installed::inventory(&registry);
    assert_eq!(found.models.iter().map(|m| m.name.as_str()).collect::<Vec<_>>(), ["clip_toy"]);
}

/// Towers for colours locate red things in a scene that they described. They cannot decide
/// presence: they have no words for alternatives.
#[test]
fn fetched_model_describes_scene() {
    let place = Place::new();
    fetch_clip(&place);
    let built_in = Registry::open(None).unwrap();
    let pack = built_in.folders().iter().find(|f| f.join("xfeat.onnx").exists()).expect("run tools/setup");
    for file in std::fs::read_dir(pack).unwrap().flatten().filter(|f| f.path().is_file()) {
        std::fs::copy(file.path(), place.at(&file.file_name().to_string_lossy())).unwrap();
    }
    let splatvk = |arguments: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_splatvk"));
        command.args(arguments).current_dir(place.folder.path());
        succeeds(command.arg("--models").arg(place.models()))
    };
    let json = |text: &str| serde_json::from_str::<serde_json::Value>(text).unwrap();
    let spec = SceneSpec {
        seed: 2,
        size: (160, 120),
        views: 3,
        held_out: 1,
        pose_noise: 0.0,
        ..SceneSpec::default()
    };
    generate(&place.folder.path().join("data"), &spec, &InjectedErrors::NONE, &Silent).unwrap();
    let given = ["--init", "cameras:data/cameras_noisy.json", "--masks", "dir:data/regions_exact"];
    let short = ["--preset", "draft", "--iterations", "30", "--out", "scene", "--json"];
    let run = json(&splatvk(&[&["run", "data/images"], &given[..], &short[..]].concat()));
    assert_eq!(run["config"]["plan"]["features"], "clip_toy");
    let answers = json(&splatvk(&["query", "scene", "red", "--out", "answers", "--json"]));
    let red = &answers["queries"][0];
    let truth = json(&std::fs::read_to_string(place.folder.path().join("data/ground_truth.json")).unwrap());
    let labels = truth["labels"].as_object().unwrap();
    let red_box: u8 = labels.iter().find(|(_, name)| *name == "red box").unwrap().0.parse().unwrap();
    for view in red["views"].as_array().unwrap() {
        let masks = format!("data/masks/{}.png", view["view"].as_str().unwrap());
        let masks = image::open(place.folder.path().join(masks)).unwrap().to_luma8();
        let at = [0, 1].map(|k| view["location"][k].as_f64().unwrap() as u32);
        assert_eq!(masks.get_pixel(at[0], at[1]).0[0], red_box, "{view}");
    }
}

/// Killed twenty times at any point, then undisturbed.
#[test]
fn killed_fetch_resumes() {
    let place = Place::new();
    let network = depth_network(1 << 20);
    let file = File { pause: Duration::from_millis(15), ..File::new(&network) };
    let server = Server::start(move |r, _, s| file.send(r, s));
    let get = [DEPTH, "--yes", "--accept", DEPTH, "--force"];
    let (mut asked_on, mut whole) = (0, 0);
    for k in 0..20u64 {
        let mut child =
            place.fetch(&get, &server.address).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        // Spread over start, download (a quarter of a second), check and installation.
        std::thread::sleep(Duration::from_millis((k * 7919) % 600));
        let _ = child.kill();
        child.wait().unwrap();
        asked_on += server.requests().iter().filter(|r| r.first().is_some()).count();
        if place.at(DEPTH).exists() {
            whole += 1;
            assert_eq!(std::fs::read(place.at(DEPTH).join("model.onnx")).unwrap(), network, "after kill {k}");
            assert!(place.at(DEPTH).join("adapter.toml").exists());
            // The replacement of a model is to be interrupted, too.
            if whole > 2 {
                std::fs::remove_dir_all(place.at(DEPTH)).unwrap();
                whole = 0;
            }
        }
    }
    assert!(asked_on > 0, "no download went on where an earlier one was killed");
    succeeds(&mut place.fetch(&get, &server.address));
    assert_eq!(std::fs::read(place.at(DEPTH).join("model.onnx")).unwrap(), network);
    assert!(place.hidden().is_empty(), "{:?}", place.hidden());
}

#[test]
fn concurrent_fetch_is_refused() {
    let place = Place::new();
    let network = depth_network(1 << 18);
    let file = File { pause: Duration::from_millis(300), ..File::new(&network) };
    let server = Server::start(move |r, _, s| file.send(r, s));
    let get = [DEPTH, "--yes", "--accept", DEPTH];
    let mut first = place.fetch(&get, &server.address).stdout(Stdio::null()).spawn().unwrap();
    while server.requests().is_empty() {
        std::thread::sleep(Duration::from_millis(10));
    }
    refuses(&mut place.fetch(&get, &server.address), 2, &["another splatvk"]);
    assert!(first.wait().unwrap().success());
}

#[test]
fn fetch_uses_http_proxy() {
    let place = Place::new();
    let server = serving(&depth_network(1));
    let target = server.address.strip_prefix("http://").unwrap().to_owned();
    let proxy = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = format!("http://{}", proxy.local_addr().unwrap());
    std::thread::spawn(move || {
        for client in proxy.incoming().flatten() {
            tunnel(client, &target);
        }
    });
    // The host does not exist; only the proxy can reach it.
    let mut command = place.fetch(&[DEPTH, "--yes", "--accept", DEPTH], "http://models.invalid");
    succeeds(command.env("HTTP_PROXY", address));
    assert_eq!(server.requests().len(), 1);
}

/// Answers one CONNECT and forwards bytes in both directions.
fn tunnel(mut client: TcpStream, target: &str) {
    let mut head = Vec::new();
    let mut byte = [0];
    while !head.ends_with(b"\r\n\r\n") && client.read(&mut byte).is_ok_and(|n| n == 1) {
        head.push(byte[0]);
    }
    assert!(text(&head).starts_with("CONNECT models.invalid:80"), "{}", text(&head));
    client.write_all(b"HTTP/1.1 200 OK\r\n\r\n").unwrap();
    let mut server = TcpStream::connect(target).unwrap();
    let (mut from, mut to) = (client.try_clone().unwrap(), server.try_clone().unwrap());
    std::thread::spawn(move || std::io::copy(&mut from, &mut to));
    std::thread::spawn(move || std::io::copy(&mut server, &mut client));
}

/// A fake Python that copies prepared files instead of exporting a network.
fn python(folder: &Path, script: &str) -> String {
    use std::os::unix::fs::PermissionsExt;
    let path = folder.join("bin/python3");
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    std::fs::write(&path, script).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
    format!("{}:{}", path.parent().unwrap().display(), std::env::var("PATH").unwrap())
}

#[test]
fn export_recipe_removes_environment() {
    let place = Place::new();
    let toys = place.folder.path().join("toys");
    std::fs::create_dir(&toys).unwrap();
    clip().iter().for_each(|(name, body)| std::fs::write(toys.join(name), body).unwrap());
    let log = place.folder.path().join("log");
    let script = format!(
        r#"#!/bin/sh
echo "$@" >> {log}
[ "$2" = venv ] && {{ mkdir -p "$3/bin"; cp "$0" "$3/bin/python"; exit 0; }}
[ "$2" = pip ] && exit 0
[ -f "$(dirname "$1")/common.py" ] && [ "$(cat open_clip_pytorch_model.bin)" = weights ] || {{ echo "no weights" >&2; exit 1; }}
[ -f {fail} ] && {{ printf 'Traceback\nImportError: torch\n\n' >&2; exit 1; }}
while [ "$1" != --out ]; do shift; done
cp {toys}/* "$2"
"#,
        log = log.display(),
        fail = place.folder.path().join("fail").display(),
        toys = toys.display()
    );
    let path = python(place.folder.path(), &script);
    let server = serving(b"weights");
    std::fs::write(place.folder.path().join("fail"), "").unwrap();
    let get = || {
        let mut command = place.fetch(&["clip_vit_b16", "--yes"], &server.address);
        command.env("PATH", &path);
        command
    };
    refuses(&mut get(), 1, &["export", "ImportError: torch"]);
    assert!(!place.at("clip_vit_b16").exists() && !place.at(".fetch-clip_vit_b16/work/environment").exists());
    std::fs::remove_file(place.folder.path().join("fail")).unwrap();
    server.requests();
    succeeds(&mut get());
    assert!(server.requests().is_empty(), "the checkpoint was kept");
    assert!(place.at("clip_vit_b16/image.onnx").exists() && place.hidden().is_empty());
    let log = std::fs::read_to_string(log).unwrap();
    for part in
        ["-m venv", "install --quiet", "open-clip-torch", "export_clip.py --model ViT-B-16 --pretrained"]
    {
        assert!(log.contains(part), "{part}: {log}");
    }
}
