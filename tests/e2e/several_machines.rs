//! Runs the commands of `docs/operating/several-machines.md` verbatim: each machine is a folder, each
//! terminal a shell.

use std::collections::HashMap;
use std::io::{BufRead as _, BufReader, Write as _};
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

use crate::processes::{Watchdog, can_train, free_port, tiny_scene};

const GUIDE: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/../docs/operating/several-machines.md");
/// Much longer than a service takes to start on two busy cores.
const PATIENCE: Duration = Duration::from_secs(120);
/// A shell prints this after each block, with the exit code.
const DONE: &str = "the block has ended with";

/// A block of commands of the guide.
struct Block {
    /// The step that they belong to.
    step: String,
    /// The machine, and the terminal if there are two.
    terminal: (String, String),
    commands: String,
}

/// All blocks of the guide. Before each stands a line `On **MACHINE**:` or `On **MACHINE**, terminal 2:`.
fn blocks_of(guide: &str) -> Vec<Block> {
    let (mut blocks, mut step, mut place) = (Vec::new(), String::new(), None);
    let mut lines = guide.lines();
    while let Some(line) = lines.next() {
        if let Some(title) = line.strip_prefix("## ") {
            step = title.to_owned();
        } else if let Some(rest) = line.strip_prefix("On **") {
            let (machine, terminal) = rest.split_once("**").expect("the end of the name");
            let terminal = terminal.trim_start_matches(',').trim_end_matches(':').trim();
            place = Some((machine.to_owned(), terminal.to_owned()));
        } else if line.starts_with("```") {
            let commands: Vec<&str> = lines.by_ref().take_while(|line| !line.starts_with("```")).collect();
            let terminal = place.take().unwrap_or_else(|| panic!("{step}: where are {commands:?} run?"));
            blocks.push(Block { step: step.clone(), terminal, commands: commands.join("\n") });
        }
    }
    blocks
}

/// The test site: folders for the machines, and replacements of the guide's names.
struct Site {
    folder: PathBuf,
    /// Prefixes of commands that run until they are stopped.
    services: [&'static str; 2],
    instead: Vec<(&'static str, String)>,
}

impl Site {
    fn machine(&self, name: &str) -> PathBuf {
        self.folder.join(name)
    }

    /// The commands with this machine's address, folders and scene, and services in the background.
    fn here(&self, block: &Block) -> String {
        let mut commands = block.commands.replace("\\\n", " ");
        for (of_the_guide, here) in &self.instead {
            commands = commands.replace(of_the_guide, here);
        }
        let log = self.log(&block.terminal.0);
        // It ends with this test, even if the test is killed.
        let lives = format!("< <(while kill -0 {} 2>/dev/null; do sleep 1; done)", std::process::id());
        let line = |line: &str| match self.services.iter().any(|service| line.starts_with(service)) {
            true => format!("{line} --stop-with-stdin {lives} >'{}' 2>&1 &\n", log.display()),
            false => format!("{line}\n"),
        };
        commands.lines().map(line).collect()
    }

    /// The output of a machine's service.
    fn log(&self, machine: &str) -> PathBuf {
        self.machine(machine).join("service.log")
    }

    /// Waits until the service of a machine prints these words.
    fn wait_for(&self, machine: &str, words: &str) {
        let begin = Instant::now();
        loop {
            let said = std::fs::read_to_string(self.log(machine)).unwrap_or_default();
            if said.contains(words) {
                return;
            }
            assert!(begin.elapsed() < PATIENCE, "{machine} never printed {words:?}: {said}");
            std::thread::sleep(Duration::from_millis(100));
        }
    }
}

/// A shell with its folder, exports and variables. All its processes end with it.
struct Terminal {
    shell: Child,
    input: ChildStdin,
    output: BufReader<ChildStdout>,
    _watchdog: Watchdog,
}

impl Terminal {
    fn open(site: &Site, machine: &str) -> Self {
        let folder = site.machine(machine);
        std::fs::create_dir_all(&folder).unwrap();
        let program = Path::new(env!("CARGO_BIN_EXE_fathom")).parent().unwrap();
        let path = std::env::var_os("PATH").unwrap_or_default();
        let paths = [program.to_owned()].into_iter().chain(std::env::split_paths(&path));
        let mut command = Command::new("bash");
        for (name, _) in std::env::vars_os() {
            if name.to_str().is_some_and(|name| name.starts_with("FATHOM_") && name != "FATHOM_LOG") {
                command.env_remove(name);
            }
        }
        let mut shell = command
            .args(["--noprofile", "--norc"])
            .env("PATH", std::env::join_paths(paths).unwrap())
            // Trains on the CPU without a GPU.
            .env("FATHOM_ALLOW_CPU", "1")
            .current_dir(&folder)
            .process_group(0)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .expect("bash starts");
        let watchdog = Watchdog::over(&shell);
        let mut input = shell.stdin.take().unwrap();
        let output = BufReader::new(shell.stdout.take().unwrap());
        // The other machines are folders beside this one: `scp a b gpu1:` copies there.
        let scp = "scp() { local to=\"../${@: -1}\"; to=\"${to%:}\"; mkdir -p \"$to\"; cp -p -- \"${@:1:$#-1}\" \"$to/\"; }";
        writeln!(input, "set -e -o pipefail\n{scp}").unwrap();
        Self { shell, input, output, _watchdog: watchdog }
    }

    /// Runs a block, which must succeed; returns its output.
    fn run(&mut self, commands: &str, file: &Path) -> String {
        // From a file, because the block's processes must not read the following commands.
        std::fs::write(file, commands).unwrap();
        writeln!(self.input, "source '{}' </dev/null; echo '{DONE}' $?", file.display()).unwrap();
        let mut said = String::new();
        loop {
            let mut line = String::new();
            let read = self.output.read_line(&mut line).expect("text");
            assert!(read > 0, "this failed:\n{commands}\nit printed: {said}");
            if let Some(status) = line.strip_prefix(DONE) {
                assert_eq!(status.trim(), "0", "{commands}\n{said}");
                return said;
            }
            said += &line;
        }
    }
}

impl Drop for Terminal {
    fn drop(&mut self) {
        // The group includes the services. Either call may fail because it has already ended.
        let group = format!("-{}", self.shell.id());
        let _ = Command::new("kill").args(["-9", "--", &group]).stderr(Stdio::null()).status();
        let _ = self.shell.wait();
    }
}

/// Whether a program that the guide needs exists; prints a note if not.
fn is_there(program: &str, test: &str) -> bool {
    let is_there = Command::new(program).arg("version").stdout(Stdio::null()).status().is_ok();
    if !is_there {
        eprintln!("{test} is skipped: there is no {program}");
    }
    is_there
}

#[test]
fn the_guide_to_several_machines_works_verbatim() {
    let test = "the_guide_to_several_machines_works_verbatim";
    if !is_there("openssl", test) || !can_train(test) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let scene = tiny_scene(folder.path());
    let site = Site {
        folder: folder.path().to_owned(),
        services: ["fathom coordinator ", "fathom worker "],
        instead: vec![
            ("10.0.0.1:7420", format!("127.0.0.1:{}", free_port())),
            ("10.0.0.1", "127.0.0.1".to_owned()),
            ("/srv/fathom", folder.path().join("srv").to_string_lossy().into_owned()),
            ("submit DATA ", format!("submit {scene} --iterations 60 --max-gaussians 2000 ")),
        ],
    };
    let guide = std::fs::read_to_string(GUIDE).expect(GUIDE);
    let blocks = blocks_of(&guide);
    for (of_the_guide, _) in &site.instead {
        assert!(blocks.iter().any(|block| block.commands.contains(of_the_guide)), "{of_the_guide}");
    }
    let steps: Vec<&str> = guide.lines().filter_map(|line| line.strip_prefix("## ")).collect();
    for (index, step) in steps.iter().enumerate() {
        assert!(step.starts_with(&format!("{}. ", index + 1)), "step {} is {step:?}", index + 1);
        assert!(blocks.iter().any(|block| block.step == *step), "{step} has no commands");
    }

    let mut terminals: HashMap<(String, String), Terminal> = HashMap::new();
    for (index, block) in blocks.iter().enumerate() {
        let (machine, _) = &block.terminal;
        let open = || Terminal::open(&site, machine);
        let terminal = terminals.entry(block.terminal.clone()).or_insert_with(open);
        let commands = site.here(block);
        let said = terminal.run(&commands, &folder.path().join(format!("block-{index}.sh")));
        eprintln!("{} ({machine})\n{said}", block.step);
        if block.commands.starts_with("fathom coordinator ") {
            site.wait_for(machine, "listening on https://127.0.0.1:");
        }
        if block.step.contains("Revoke") {
            assert!(said.contains(": ana, revoked"), "{said}");
        }
        check_after(&block.step, &mut terminals, &site, &folder.path().join("check.sh"));
    }
    let model = std::fs::read(site.machine("desk").join("OUT/model.ply")).expect("the model");
    assert!(model.starts_with(b"ply\n"), "it is no PLY");
}

/// Checks after a step, beyond the success of its commands.
fn check_after(step: &str, terminals: &mut HashMap<(String, String), Terminal>, site: &Site, file: &Path) {
    let mut ask = |machine: &str, terminal: &str, commands: &str| {
        let place = (machine.to_owned(), terminal.to_owned());
        terminals.get_mut(&place).expect("it is open").run(commands, file)
    };
    let (_, name) = step.split_once(". ").unwrap_or_default();
    match name {
        "Start a worker" | "Add a worker while the job runs" => {
            let machine = if name.starts_with("Start") { "gpu1" } else { "gpu2" };
            let begin = Instant::now();
            while !ask("coordinator", "terminal 2", "fathom worker list").contains(machine) {
                let said = || std::fs::read_to_string(site.log(machine)).unwrap_or_default();
                assert!(begin.elapsed() < PATIENCE, "{machine} is not there: {}", said());
                std::thread::sleep(Duration::from_millis(300));
            }
        }
        "Renew the certificate" => {
            site.wait_for("coordinator", "reloaded the certificates");
            // With the older copy of another machine.
            ask("coordinator", "terminal 2", "FATHOM_TLS_CA=../gpu1/server.pem fathom ls");
        }
        "Revoke a token" => {
            let said = ask("desk", "", "! fathom ls 2>&1");
            assert!(said.contains("was revoked"), "{said}");
        }
        _ => {}
    }
}
