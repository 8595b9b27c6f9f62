//! Compares the protos with those of the latest release: its clients and workers must understand every
//! message.
//!
//! A message, field, value or method may be added. Those of the release must stay, with number, type and name
//! (JSON uses the name). Only a new major version may remove any. `make release-protos` commits the protos of
//! a new release.

use std::collections::BTreeMap;

use prost::Message as _;
use prost_types::{DescriptorProto, EnumDescriptorProto, FileDescriptorSet};

/// The descriptor that the latest release committed.
const RELEASED: &[u8] = include_bytes!("../released/0.2.0.bin");

/// Every item that a message depends on, by full name, one line each.
fn contract(set: &FileDescriptorSet) -> BTreeMap<String, String> {
    let mut found = BTreeMap::new();
    for file in &set.file {
        let package = file.package();
        // Foreign types, such as Google's, are not ours to change.
        if !package.starts_with("fathom.") {
            continue;
        }
        file.message_type.iter().for_each(|message| add_message(&mut found, package, message));
        file.enum_type.iter().for_each(|values| add_enum(&mut found, package, values));
        for service in &file.service {
            for method in &service.method {
                let name = format!("{package}.{}/{}", service.name(), method.name());
                let stream = |is: bool| if is { "stream " } else { "" };
                let (from, to) = (stream(method.client_streaming()), stream(method.server_streaming()));
                let line = format!("({from}{}) returns ({to}{})", method.input_type(), method.output_type());
                found.insert(name, line);
            }
        }
    }
    found
}

fn add_message(found: &mut BTreeMap<String, String>, scope: &str, message: &DescriptorProto) {
    let scope = format!("{scope}.{}", message.name());
    for field in &message.field {
        let oneof = field.oneof_index.and_then(|index| message.oneof_decl.get(index as usize));
        let line = format!(
            "{:?} {:?} {} = {} in {:?}",
            field.label(),
            field.r#type(),
            field.type_name(),
            field.number(),
            oneof.map(|oneof| oneof.name().to_owned())
        );
        found.insert(format!("{scope}.{}", field.name()), line);
    }
    message.nested_type.iter().for_each(|nested| add_message(found, &scope, nested));
    message.enum_type.iter().for_each(|nested| add_enum(found, &scope, nested));
    found.insert(scope, "message".to_owned());
}

fn add_enum(found: &mut BTreeMap<String, String>, scope: &str, values: &EnumDescriptorProto) {
    for value in &values.value {
        found.insert(format!("{scope}.{}", value.name()), format!("= {}", value.number()));
    }
}

/// Items of `released` that are missing or different in `now`.
fn broken(released: &FileDescriptorSet, now: &FileDescriptorSet) -> Vec<String> {
    let now = contract(now);
    let fault = |(name, line): (String, String)| match now.get(&name) {
        None => Some(format!("{name} is gone; it was {line}")),
        Some(found) if *found != line => Some(format!("{name} is {found}; it was {line}")),
        Some(_) => None,
    };
    contract(released).into_iter().filter_map(fault).collect()
}

fn decoded(bytes: &[u8]) -> FileDescriptorSet {
    FileDescriptorSet::decode(bytes).expect("a descriptor set")
}

#[test]
fn nothing_of_the_latest_release_is_missing_or_changed() {
    let faults = broken(&decoded(RELEASED), &decoded(fathom_proto::FILE_DESCRIPTOR_SET));
    assert!(
        faults.is_empty(),
        "clients and workers of 0.2.0 would not be understood:\n{}",
        faults.join("\n")
    );
}

#[test]
fn breaking_changes_are_found_and_additions_are_not() {
    let now = decoded(fathom_proto::FILE_DESCRIPTOR_SET);
    assert_eq!(broken(&now, &now), Vec::<String>::new());
    let job = |set: &FileDescriptorSet| {
        let file = set.file.iter().position(|file| file.package() == "fathom.v1" && !file.service.is_empty());
        file.expect("a file with a service")
    };
    type Change = fn(&mut prost_types::FileDescriptorProto);
    let changes: [(&str, Change); 6] = [
        ("is gone; it was message", |file| drop(file.message_type.remove(0))),
        ("is gone", |file| drop(file.message_type[0].field.remove(0))),
        ("= 77", |file| file.message_type[0].field[0].number = Some(77)),
        ("it was", |file| {
            file.message_type[0].field[0].set_type(prost_types::field_descriptor_proto::Type::Sint64);
        }),
        ("is gone", |file| drop(file.service[0].method.remove(0))),
        ("stream ", |file| file.service[0].method[0].server_streaming = Some(true)),
    ];
    for (expected, change) in changes {
        let mut changed = now.clone();
        let file = job(&changed);
        change(&mut changed.file[file]);
        let faults = broken(&now, &changed);
        assert!(faults.iter().any(|fault| fault.contains(expected)), "{expected:?}: {faults:?}");
        // In reverse this is an addition, unless an item was changed.
        if expected.starts_with("is gone") {
            assert_eq!(broken(&changed, &now), Vec::<String>::new(), "an addition is refused");
        }
    }
}
