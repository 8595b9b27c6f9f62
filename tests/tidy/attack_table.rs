//! Checks the table of attacks in `docs/operating/attacks.md`: every attack is in it, and all its tests
//! exist.

use std::path::Path;

/// Number of attacks that were tried.
const ATTACKS: u32 = 157;

/// The text between backticks in a cell.
fn quoted(cell: &str) -> Vec<&str> {
    cell.split('`').skip(1).step_by(2).collect()
}

#[test]
fn every_attack_is_in_the_table_and_names_a_test() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).ancestors().nth(2).unwrap();
    let table = std::fs::read_to_string(root.join("docs/operating/attacks.md")).unwrap();
    let mut numbers = Vec::<u32>::new();
    for row in table.lines().filter(|line| line.starts_with("| ") && !line.starts_with("| no.")) {
        let cells: Vec<&str> = row.trim_matches('|').split('|').map(str::trim).collect();
        let [range, _, _, tests] = cells.as_slice() else { panic!("no four cells: {row}") };
        let (first, last) = range.split_once('-').unwrap_or((range, range));
        let range: Vec<u32> = (first.parse().unwrap()..=last.parse().unwrap()).collect();
        let mut file = String::new();
        let named = quoted(tests);
        assert!(!named.is_empty(), "a row without a test: {row}");
        for name in named {
            if name.contains('/') {
                let path = root.join(name);
                file = std::fs::read_to_string(&path)
                    .unwrap_or_else(|error| panic!("{}: {error}", path.display()));
                assert!(file.contains("#[test]") || file.contains("#[tokio::test"), "{name} has no test");
            } else {
                assert!(file.contains(&format!("fn {name}(")), "there is no test {name}: {row}");
            }
        }
        numbers.extend(range);
    }
    assert_eq!(numbers, (1..=ATTACKS).collect::<Vec<u32>>());
}
